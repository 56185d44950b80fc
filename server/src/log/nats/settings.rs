//! The settings of NATS with which it would lose messages, or refuse them: operators edit streams, and others make them.

use std::time::Duration;

use async_nats::jetstream::stream::{
    Config, DiscardPolicy, PersistenceMode, RetentionPolicy, StorageType, Stream,
};

use super::NatsError;

/// The most bytes of a value of the bucket.
const MAX_VALUE_BYTES: usize = 64 * 1024;

/// Refuses a stream of records that would not keep all messages of `subject`, or not take those that `max_payload` allows.
pub(super) fn check_records(
    stream: &Stream,
    subject: &str,
    max_payload: usize,
) -> Result<(), NatsError> {
    check(stream, |config| {
        faults_of_records(config, subject, max_payload)
    })
}

/// Refuses the stream of a bucket that would not keep every newest value of `subject`.
pub(super) fn check_bucket(stream: &Stream, subject: &str) -> Result<(), NatsError> {
    check(stream, |config| faults(config, subject, MAX_VALUE_BYTES))
}

fn check(stream: &Stream, faults: impl FnOnce(&Config) -> Vec<String>) -> Result<(), NatsError> {
    let config = &stream.cached_info().config;
    let faults = faults(config);
    match faults.is_empty() {
        true => Ok(()),
        false => Err(NatsError::UnfitStream {
            stream: config.name.clone(),
            faults,
        }),
    }
}

fn faults_of_records(config: &Config, subject: &str, max_payload: usize) -> Vec<String> {
    let most = config.max_messages_per_subject;
    let of_records = [
        (most > 0).then(|| format!("max_msgs_per_subject: {most}")),
        config.deny_purge.then(|| "deny_purge: true".into()),
        (!config.allow_atomic_publish).then(|| "allow_atomic: false".into()),
    ];
    let mut faults = faults(config, subject, max_payload);
    faults.extend(of_records.into_iter().flatten());
    faults
}

/// The settings by which a stream loses or refuses messages of `subject` of up to `max_bytes`, in the words of NATS.
fn faults(config: &Config, subject: &str, max_bytes: usize) -> Vec<String> {
    let Config {
        subjects,
        retention,
        storage,
        max_age,
        max_consumers,
        max_message_size,
        ..
    } = config;
    let drops_oldest = config.discard == DiscardPolicy::Old;
    let limit = |name: &str, most: i64| {
        (most > 0 && drops_oldest).then(|| format!("{name}: {most} with discard: old"))
    };
    let is_small = (1..max_bytes as i64).contains(&i64::from(*max_message_size));
    let faults = [
        (*subjects != [subject]).then(|| format!("subjects: {subjects:?}, not {subject}")),
        config
            .subject_transform
            .is_some()
            .then(|| "a subject_transform".into()),
        config.mirror.is_some().then(|| "a mirror".into()),
        (*retention != RetentionPolicy::Limits).then(|| format!("retention: {retention:?}")),
        (*storage != StorageType::File).then(|| format!("storage: {storage:?}")),
        (*max_age != Duration::ZERO).then(|| format!("max_age: {max_age:?}")),
        limit("max_bytes", config.max_bytes),
        limit("max_msgs", config.max_messages),
        is_small.then(|| format!("max_msg_size: {max_message_size}, below {max_bytes}")),
        (*max_consumers > 0).then(|| format!("max_consumers: {max_consumers}")),
        config
            .consumer_limits
            .is_some()
            .then(|| "consumer_limits".into()),
        (config.persist_mode == Some(PersistenceMode::Async)).then(|| "persist_mode: async".into()),
        config.no_ack.then(|| "no_ack: true".into()),
        config.sealed.then(|| "sealed: true".into()),
    ];
    faults.into_iter().flatten().collect()
}

#[cfg(test)]
mod tests {
    use async_nats::jetstream::stream::{ConsumerLimits, Source, SubjectTransform};

    use super::*;

    const MAX_PAYLOAD: usize = 1 << 20;

    #[test]
    fn each_setting_that_loses_or_refuses_records_is_told() {
        let kept = Config {
            subjects: vec!["log.*".into()],
            discard: DiscardPolicy::New,
            allow_atomic_publish: true,
            max_bytes: 1 << 30,
            max_messages: 1 << 20,
            max_messages_per_subject: -1,
            max_message_size: MAX_PAYLOAD as i32,
            ..Config::default()
        };
        let faults = |config: &Config| faults_of_records(config, "log.*", MAX_PAYLOAD);
        assert_eq!(faults(&kept), [""; 0]);
        type Edit = fn(&mut Config);
        let edits: [(Edit, &str); 15] = [
            (
                |it| it.subjects = vec!["other.*".into()],
                "subjects: [\"other.*\"], not log.*",
            ),
            (
                |it| {
                    it.subject_transform = Some(SubjectTransform {
                        source: "log.*".into(),
                        destination: "other.*".into(),
                    });
                },
                "a subject_transform",
            ),
            (|it| it.mirror = Some(Source::default()), "a mirror"),
            (
                |it| it.retention = RetentionPolicy::WorkQueue,
                "retention: WorkQueue",
            ),
            (|it| it.storage = StorageType::Memory, "storage: Memory"),
            (
                |it| it.max_age = Duration::from_secs(3600),
                "max_age: 3600s",
            ),
            (
                |it| it.discard = DiscardPolicy::Old,
                "max_bytes: 1073741824 with discard: old, max_msgs: 1048576 with discard: old",
            ),
            (
                |it| it.max_message_size = MAX_PAYLOAD as i32 - 1,
                "max_msg_size: 1048575, below 1048576",
            ),
            (|it| it.max_consumers = 1, "max_consumers: 1"),
            (
                |it| it.consumer_limits = Some(ConsumerLimits::default()),
                "consumer_limits",
            ),
            (
                |it| it.persist_mode = Some(PersistenceMode::Async),
                "persist_mode: async",
            ),
            (|it| it.no_ack = true, "no_ack: true"),
            (|it| it.sealed = true, "sealed: true"),
            (
                |it| it.max_messages_per_subject = 1,
                "max_msgs_per_subject: 1",
            ),
            (|it| it.deny_purge = true, "deny_purge: true"),
        ];
        for (edit, told) in edits {
            let mut edited = kept.clone();
            edit(&mut edited);
            assert_eq!(faults(&edited).join(", "), told);
        }
        let no_batches = Config {
            allow_atomic_publish: false,
            ..kept
        };
        assert_eq!(faults(&no_batches), ["allow_atomic: false"]);
    }
}
