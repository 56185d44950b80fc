//! The connection to NATS: the streams, and the places of messages in them.

use std::{error::Error as _, io, sync::atomic::Ordering::Relaxed, time::Duration};

use async_nats::{
    ConnectError, ConnectErrorKind, ConnectOptions, ServerAddr,
    jetstream::{
        self, Context, ErrorCode,
        context::ContextBuilder,
        message::StreamMessage,
        stream::{Config, DiscardPolicy, LastRawMessageError, LastRawMessageErrorKind, Stream},
    },
    rustls,
};
use parking_lot::Mutex;
use tokio::time::{Instant, MissedTickBehavior, interval, timeout};
use tracing::warn;

use super::{NatsError, NatsOptions, message::PackPosition, settings::check_records};
use crate::log::{LogError, Uid};

/// The number of streams that the indices share. Each has a leader of its own, so the work is spread over the servers
/// of NATS; an index stays in the stream that its uid chooses.
const STREAMS: usize = 4;

/// The oldest version of NATS that Wayfold is tested with; 2.15 rewrote how JetStream syncs.
const MIN_VERSION: (i64, i64) = (2, 15);

/// The bytes that the headers of a message take at most; they count against the limit of NATS.
const HEADER_BYTES: usize = 1024;

/// A request to NATS without an answer for this long counts as lost.
pub(super) const REQUEST_TIMEOUT: Duration = Duration::from_secs(3);

/// The timeout of a message, and of a request that reads one. It is shorter: a stream drops both silently while it elects a
/// leader, and writers wait meanwhile.
pub(super) const MESSAGE_TIMEOUT: Duration = Duration::from_secs(1);

/// The time between two pings of NATS. After three pings without an answer the client connects to another server of NATS.
/// The client's default is a minute, and every write would wait for that long.
const PING_INTERVAL: Duration = Duration::from_secs(1);

/// The time in which NATS must give what a starting server asks for, and the time between two requests.
const START_TIME: Duration = Duration::from_secs(60);
const START_INTERVAL: Duration = Duration::from_secs(1);

/// The longest wait before the next attempt to connect.
const MAX_RECONNECT_DELAY: Duration = Duration::from_millis(500);

/// See the module.
pub(super) struct Connection {
    pub(super) context: Context,
    name: String,
    pub(super) replicas: usize,
    streams: Vec<Stream>,
    /// The greatest payload of a message.
    pub(super) max_payload: usize,
}

impl Connection {
    /// Connects, and creates the missing streams and buckets.
    pub(super) async fn open(options: &NatsOptions) -> Result<Self, NatsError> {
        let mut connecting = ConnectOptions::new()
            .name("wayfold")
            .ping_interval(PING_INTERVAL)
            .reconnect_delay_callback(|attempts| {
                let delay = Duration::from_millis(20) * attempts.min(100) as u32;
                delay.min(MAX_RECONNECT_DELAY)
            });
        if let Some(file) = &options.credentials {
            let unreadable = |source| NatsError::Credentials {
                file: file.display().to_string(),
                source,
            };
            let text = std::fs::read_to_string(file).map_err(unreadable)?;
            connecting = connecting.credentials(&text).map_err(unreadable)?;
        }
        if let Some(ca) = &options.ca {
            connecting = connecting
                .add_root_certificates(ca.clone())
                .require_tls(true);
        }
        let unreachable = |error: &dyn std::error::Error| NatsError::Unreachable {
            servers: without_passwords(&options.servers),
            what: error.to_string(),
        };
        let servers = options.servers.split(',').map(|url| url.trim().parse());
        let servers: Vec<ServerAddr> = servers
            .collect::<Result<_, _>>()
            .map_err(|error| unreachable(&error))?;
        let mut users = servers
            .iter()
            .filter_map(|it| it.username().zip(it.password()));
        if let Some((user, password)) = users.next() {
            connecting = connecting.user_and_password(user.to_owned(), password.to_owned());
        }
        let rejected = Mutex::new(None);
        let connect = || async {
            let attempt = connecting.clone().connect(servers.clone()).await;
            let rejection = attempt.as_ref().err().and_then(|it| rejection(options, it));
            match rejection {
                Some(rejection) if servers.len() == 1 => return Ok(Err(rejection)),
                // The next attempt may ask another server of NATS first.
                rejection => *rejected.lock() = rejection,
            }
            attempt.map(Ok)
        };
        let client = patiently("connection", connect).await;
        let client = client.map_err(|error| {
            let rejected = rejected.lock().take();
            rejected.unwrap_or_else(|| unreachable(&error))
        })??;
        let (major, minor) = MIN_VERSION;
        if !client.is_server_compatible(major, minor, 0) {
            warn!(
                version = client.server_info().version,
                "NATS is older than {major}.{minor}: such versions have lost acknowledged messages"
            );
        }
        let bytes = client.server_info().max_payload;
        let least = options.min_payload.max(HEADER_BYTES + 1);
        if bytes < least {
            return Err(NatsError::SmallMessages { bytes, least });
        }
        let max_payload = bytes - HEADER_BYTES;
        let context = ContextBuilder::new()
            .timeout(REQUEST_TIMEOUT)
            .ack_timeout(2 * REQUEST_TIMEOUT)
            .build(client);
        let mut connection = Self {
            context,
            name: options.name.clone(),
            replicas: options.replicas,
            streams: Vec::new(),
            max_payload,
        };
        for number in 0..STREAMS {
            let config = connection.stream_config(number);
            let what = format!("stream {}", config.name);
            let create = || connection.context.get_or_create_stream(config.clone());
            let stream = patiently(&what, create).await?;
            let replicas = stream.cached_info().config.num_replicas;
            if replicas != options.replicas {
                warn!(
                    what,
                    replicas,
                    expected = options.replicas,
                    "created with other cluster.replicas"
                );
            }
            check_records(&stream, &config.subjects[0], bytes)?;
            connection.streams.push(stream);
        }
        Ok(connection)
    }

    fn stream_config(&self, number: usize) -> Config {
        Config {
            name: format!("{}-log-{number}", self.name),
            subjects: vec![format!("{}.log.{number}.*", self.name)],
            num_replicas: self.replicas,
            discard: DiscardPolicy::New,
            allow_atomic_publish: true,
            description: Some("the records of Wayfold's indices".into()),
            ..Config::default()
        }
    }

    /// The number of times that the client has connected to a server of NATS.
    pub(super) fn connects(&self) -> u64 {
        let statistics = self.context.client().statistics();
        statistics.connects.load(Relaxed)
    }

    /// The name of the bucket of the catalogue.
    pub(super) fn catalogue_name(&self) -> String {
        format!("{}-catalogue", self.name)
    }

    fn stream_number(uid: Uid) -> usize {
        usize::from(uid.as_bytes()[0]) % STREAMS
    }

    /// The stream of an index.
    pub(super) fn stream(&self, uid: Uid) -> &Stream {
        &self.streams[Self::stream_number(uid)]
    }

    /// The subject of an index.
    pub(super) fn subject(&self, uid: Uid) -> String {
        format!("{}.log.{}.{uid}", self.name, Self::stream_number(uid))
    }

    /// The newest message of an index, of the stream's leader; [`PackPosition::START`] if there is none.
    pub(super) async fn last(&self, uid: Uid) -> Result<PackPosition, LogError> {
        let subject = self.subject(uid);
        let last = self.stream(uid).get_last_raw_message_by_subject(&subject);
        match read(last).await? {
            Some(message) => PackPosition::of(uid, &message),
            None => Ok(PackPosition::START),
        }
    }

    /// The first message of an index from `sequence` on, if there is one.
    pub(super) async fn next(
        &self,
        uid: Uid,
        sequence: u64,
    ) -> Result<Option<(PackPosition, StreamMessage)>, LogError> {
        let subject = self.subject(uid);
        let next = self
            .stream(uid)
            .get_first_raw_message_by_subject(subject, sequence);
        match read(next).await? {
            Some(message) => Ok(Some((PackPosition::of(uid, &message)?, message))),
            None => Ok(None),
        }
    }

    /// Forgets the messages of an index before this sequence number.
    pub(super) async fn purge_before(&self, uid: Uid, sequence: u64) -> Result<(), LogError> {
        let purge = self.stream(uid).purge().sequence(sequence);
        let purge = purge.filter(self.subject(uid));
        within(async { purge.await.map(drop).map_err(unreachable) }).await
    }

    /// Forgets the messages of an index.
    pub(super) async fn purge(&self, uid: Uid) -> Result<(), LogError> {
        let purge = self.stream(uid).purge().filter(self.subject(uid));
        within(async { purge.await.map(drop).map_err(unreachable) }).await
    }
}

/// The error of a start that ends with this attempt to connect; None if the same server may take another one.
fn rejection(options: &NatsOptions, error: &ConnectError) -> Option<NatsError> {
    let (servers, what) = (without_passwords(&options.servers), error.to_string());
    // The library reports a failed handshake as an error of the socket.
    let cause = error.source().and_then(|it| it.downcast_ref::<io::Error>());
    let cause = cause.and_then(io::Error::get_ref);
    match error.kind() {
        ConnectErrorKind::AuthorizationViolation | ConnectErrorKind::Authentication => {
            Some(NatsError::Unauthorized { servers, what })
        }
        ConnectErrorKind::Io if !cause.is_some_and(|it| it.is::<rustls::Error>()) => None,
        ConnectErrorKind::Io | ConnectErrorKind::Tls => {
            let ca = options.ca.as_ref();
            let ca = ca.map_or_else(|| "off".into(), |file| file.display().to_string());
            Some(NatsError::Tls { servers, what, ca })
        }
        _ => None,
    }
}

/// The URLs without their users and passwords.
fn without_passwords(servers: &str) -> String {
    let hide = |url: &str| match (url.split_once("://"), url.rsplit_once('@')) {
        (Some((scheme, _)), Some((_, host))) => format!("{scheme}://…@{host}"),
        (None, Some((_, host))) => format!("…@{host}"),
        (_, None) => url.to_owned(),
    };
    servers.split(',').map(hide).collect::<Vec<_>>().join(",")
}

/// The message that a request reads; None if there is no such message.
async fn read(
    request: impl Future<Output = Result<StreamMessage, LastRawMessageError>>,
) -> Result<Option<StreamMessage>, LogError> {
    let late = |_| LogError::Unreachable {
        what: "no message in time".into(),
    };
    found(timeout(MESSAGE_TIMEOUT, request).await.map_err(late)?)
}

/// The message of an answer; None if there is no such message.
pub(super) fn found(
    answer: Result<StreamMessage, LastRawMessageError>,
) -> Result<Option<StreamMessage>, LogError> {
    match answer {
        Ok(message) => Ok(Some(message)),
        Err(error) if error.kind() == LastRawMessageErrorKind::NoMessageFound => Ok(None),
        Err(error) => Err(unreachable(error)),
    }
}

/// Bounds a request: the library waits without a bound for a place in the queue of a connection that is down.
pub(super) async fn within<T>(
    request: impl Future<Output = Result<T, LogError>>,
) -> Result<T, LogError> {
    let late = |_| LogError::Unreachable {
        what: "no answer in time".into(),
    };
    timeout(2 * REQUEST_TIMEOUT, request).await.map_err(late)?
}

/// Asks NATS for a stream or a bucket for up to [`START_TIME`]: servers of NATS that have just started elect a leader first.
pub(super) async fn patiently<T, E: std::error::Error, Attempt: Future<Output = Result<T, E>>>(
    what: &str,
    ask: impl Fn() -> Attempt,
) -> Result<T, NatsError> {
    let (until, mut attempts) = (Instant::now() + START_TIME, interval(START_INTERVAL));
    attempts.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        attempts.tick().await;
        match ask().await {
            Ok(given) => return Ok(given),
            Err(error) if Instant::now() >= until => {
                return Err(NatsError::Refused {
                    what: what.to_owned(),
                    why: error.to_string(),
                });
            }
            Err(error) => warn!(what, %error, "NATS does not give it yet; trying again"),
        }
    }
}

/// The error of a request that NATS has not answered.
pub(super) fn unreachable(error: impl std::error::Error) -> LogError {
    LogError::Unreachable {
        what: error.to_string(),
    }
}

/// The code of an error of JetStream.
pub(super) fn code(error: &dyn std::error::Error) -> Option<ErrorCode> {
    let source = error.source()?;
    let error = source.downcast_ref::<jetstream::Error>()?;
    Some(error.error_code())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_error_names_no_password() {
        let shown = without_passwords("nats://me:se@cret@one:4222,two:4222,me:secret@three");
        assert_eq!(shown, "nats://…@one:4222,two:4222,…@three");
    }
}
