//! The settings of NATS with which it would lose messages, or refuse them: operators edit streams, and others make them.

use std::time::Duration;

use async_nats::jetstream::stream::{
    Config, DiscardPolicy, PersistenceMode, RetentionPolicy, StorageType, Stream,
};

use super::NatsError;

/// The least `max_payload`, headers included: a larger mutation is one batch of up to 1,000 messages.
pub(super) const MIN_PAYLOAD: usize = 64 * 1024;

/// Refuses a stream of records that would not keep all messages, or not take those that `max_payload` allows.
pub(super) fn check_records(stream: &Stream, max_payload: usize) -> Result<(), NatsError> {
    check(stream, |config| faults_of_records(config, max_payload))
}

/// Refuses the stream of a bucket that would not keep every newest value.
pub(super) fn check_bucket(stream: &Stream) -> Result<(), NatsError> {
    check(stream, faults)
}

fn check(stream: &Stream, faults: impl FnOnce(&Config) -> Vec<String>) -> Result<(), NatsError> {
    let config = &stream.cached_info().config;
    let faults = faults(config);
    match faults.is_empty() {
        true => Ok(()),
        false => Err(NatsError::Lossy {
            what: config.name.clone(),
            faults,
        }),
    }
}

fn faults_of_records(config: &Config, max_payload: usize) -> Vec<String> {
    let mut faults = faults(config);
    let (most, largest) = (config.max_messages_per_subject, config.max_message_size);
    if most > 0 {
        faults.push(format!("max_msgs_per_subject {most}"));
    }
    if (1..max_payload as i64).contains(&largest.into()) {
        faults.push(format!("max_msg_size {largest}"));
    }
    if !config.allow_atomic_publish {
        faults.push("no allow_atomic".into());
    }
    faults
}

fn faults(config: &Config) -> Vec<String> {
    let is_full = |most: i64| most > 0 && config.discard == DiscardPolicy::Old;
    let faults = [
        (
            config.retention != RetentionPolicy::Limits,
            "a retention that is not limits",
        ),
        (config.storage != StorageType::File, "no storage in files"),
        (config.max_age != Duration::ZERO, "a max_age"),
        (is_full(config.max_bytes), "max_bytes with discard old"),
        (is_full(config.max_messages), "max_msgs with discard old"),
        (
            config.persist_mode == Some(PersistenceMode::Async),
            "persist_mode async",
        ),
        (config.no_ack, "no_ack"),
        (config.sealed, "sealed"),
    ];
    let faults = faults.into_iter().filter(|(is_there, _)| *is_there);
    faults.map(|(_, fault)| fault.to_owned()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    const MAX_PAYLOAD: usize = 1 << 20;

    #[test]
    fn each_setting_that_loses_or_refuses_records_is_told() {
        let kept = Config {
            discard: DiscardPolicy::New,
            allow_atomic_publish: true,
            max_bytes: 1 << 30,
            max_messages: -1,
            max_messages_per_subject: -1,
            max_message_size: -1,
            ..Config::default()
        };
        assert!(faults_of_records(&kept, MAX_PAYLOAD).is_empty());
        let edits: [fn(&mut Config); 10] = [
            |it| it.retention = RetentionPolicy::WorkQueue,
            |it| it.storage = StorageType::Memory,
            |it| it.max_age = Duration::from_secs(3600),
            |it| it.discard = DiscardPolicy::Old,
            |it| it.persist_mode = Some(PersistenceMode::Async),
            |it| it.no_ack = true,
            |it| it.sealed = true,
            |it| it.max_messages_per_subject = 1,
            |it| it.max_message_size = 1000,
            |it| it.allow_atomic_publish = false,
        ];
        for edit in edits {
            let mut edited = kept.clone();
            edit(&mut edited);
            let faults = faults_of_records(&edited, MAX_PAYLOAD);
            assert_eq!(faults.len(), 1, "{faults:?}");
        }
    }
}
