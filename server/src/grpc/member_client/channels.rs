//! The connections to the other members, one each. After a failure a later call opens another one, with the certificates as
//! their files are then.

use std::{
    collections::BTreeMap,
    error::Error,
    fs,
    path::{Path, PathBuf},
    sync::Arc,
    time::{Duration, Instant},
};

use bytes::{Buf, BufMut, Bytes};
use parking_lot::Mutex;
use prost::Message;
use tokio::time::timeout;
use tonic::{
    ConnectError, Status,
    client::Grpc,
    codec::{Codec, DecodeBuf, Decoder, EncodeBuf, Encoder},
    transport::{Certificate, Channel, ClientTlsConfig, Endpoint, Identity},
};
use tonic_types::StatusExt;
use tracing::warn;
use wayfold_proto::v1;

use crate::{config::TlsConfig, service::NotForwarded};

/// The time in which a member accepts a connection.
const CONNECT_TIME: Duration = Duration::from_millis(500);

/// A member that could not be reached gets no mutation for this long: each of them would wait for it.
pub(super) const PAUSE: Duration = Duration::from_secs(2);

/// A connection with calls is probed after this much silence, and is lost without an answer after as long again: a network
/// may swallow all packets between two members that both reach NATS.
const PROBE_TIME: Duration = Duration::from_secs(1);

/// See the module.
pub(super) struct Channels {
    tls: Option<Files>,
    /// By address. A lock is held while its connection is opened.
    open: Mutex<BTreeMap<String, Arc<Slot>>>,
}

type Slot = tokio::sync::Mutex<Option<Connection>>;

enum Connection {
    Open(Grpc<Channel>),
    /// It failed, or could not be opened, at this time.
    Failed(Instant),
}

/// The files in PEM with which members recognise each other.
struct Files {
    peer_ca: PathBuf,
    certificate: PathBuf,
    key: PathBuf,
}

impl Files {
    fn read(&self) -> std::io::Result<ClientTlsConfig> {
        let (certificate, key) = (fs::read(&self.certificate)?, fs::read(&self.key)?);
        Ok(ClientTlsConfig::new()
            .ca_certificate(Certificate::from_pem(fs::read(&self.peer_ca)?))
            .identity(Identity::from_pem(certificate, key)))
    }
}

impl Channels {
    /// Connections with TLS if there are authorities of the members' certificates.
    pub(super) fn new(peer_ca: Option<&Path>, tls: &TlsConfig) -> Self {
        let files = |peer_ca: &Path| {
            Some(Files {
                peer_ca: peer_ca.to_owned(),
                certificate: tls.certificate()?.to_owned(),
                key: tls.key()?.to_owned(),
            })
        };
        Self {
            tls: peer_ca.and_then(files),
            open: Mutex::default(),
        }
    }

    /// The connection to a member; none for `pause` after a failure. Calls that wait for one attempt share its failure.
    pub(super) async fn get(
        &self,
        member: &str,
        pause: Duration,
    ) -> Result<Grpc<Channel>, NotForwarded> {
        let began = Instant::now();
        let slot = Arc::clone(self.open.lock().entry(member.to_owned()).or_default());
        let mut slot = slot.lock().await;
        match &*slot {
            Some(Connection::Open(open)) => return Ok(open.clone()),
            Some(Connection::Failed(at)) if *at > began || at.elapsed() < pause => {
                return Err(NotForwarded::Unsent);
            }
            Some(Connection::Failed(_)) | None => {}
        }
        let channel = match self.connect(member).await {
            Ok(channel) => channel,
            Err(error) => {
                warn!(member, %error, "cannot reach a server of the cluster");
                *slot = Some(Connection::Failed(Instant::now()));
                return Err(NotForwarded::Unsent);
            }
        };
        // The owner has checked its answer against the limits.
        let grpc = Grpc::new(channel).max_decoding_message_size(usize::MAX);
        *slot = Some(Connection::Open(grpc.clone()));
        Ok(grpc)
    }

    async fn connect(&self, member: &str) -> Result<Channel, Box<dyn Error + Send + Sync>> {
        let scheme = if self.tls.is_some() { "https" } else { "http" };
        let endpoint = Endpoint::from_shared(format!("{scheme}://{member}"))?;
        let mut endpoint = endpoint
            .connect_timeout(CONNECT_TIME)
            .tcp_nodelay(true)
            .http2_keep_alive_interval(PROBE_TIME)
            .keep_alive_timeout(PROBE_TIME);
        if let Some(files) = &self.tls {
            endpoint = endpoint.tls_config(files.read()?)?;
        }
        // The bound of the endpoint is that of TCP alone.
        Ok(timeout(CONNECT_TIME, endpoint.connect()).await??)
    }

    /// Gives up the connection to a member that has not answered, and leaves the member alone for a while. The end of a call
    /// whose deadline has passed says nothing about the member.
    pub(super) fn note(&self, member: &str, why: &NotForwarded, is_late: bool) {
        if is_late || matches!(why, NotForwarded::Refused { .. }) {
            return;
        }
        let failed = Connection::Failed(Instant::now());
        let slot = Arc::new(Slot::new(Some(failed)));
        self.open.lock().insert(member.to_owned(), slot);
    }

    /// Forgets a member that left.
    pub(super) fn forget(&self, member: &str) {
        self.open.lock().remove(member);
    }
}

/// The answer of a member that did not succeed.
pub(super) fn refusal(member: &str, status: &Status) -> NotForwarded {
    let given = v1::Status::decode(status.details());
    if let (Some(info), Ok(given)) = (status.get_details_error_info(), given) {
        return NotForwarded::Refused {
            reason: info.reason,
            status: Box::new(given),
        };
    }
    let mut cause = status.source();
    while let Some(error) = cause {
        if error.is::<ConnectError>() {
            return NotForwarded::Unsent;
        }
        cause = error.source();
    }
    NotForwarded::Unknown {
        what: format!("{member}: {}", status.message()),
    }
}

/// Messages that are encoded already.
#[derive(Clone, Copy, Default)]
pub(super) struct Raw;

impl Codec for Raw {
    type Encode = Bytes;
    type Decode = Bytes;
    type Encoder = Self;
    type Decoder = Self;

    fn encoder(&mut self) -> Self {
        Self
    }

    fn decoder(&mut self) -> Self {
        Self
    }
}

impl Encoder for Raw {
    type Item = Bytes;
    type Error = Status;

    fn encode(&mut self, message: Bytes, buffer: &mut EncodeBuf<'_>) -> Result<(), Status> {
        buffer.put(message);
        Ok(())
    }
}

impl Decoder for Raw {
    type Item = Bytes;
    type Error = Status;

    fn decode(&mut self, buffer: &mut DecodeBuf<'_>) -> Result<Option<Bytes>, Status> {
        Ok(Some(buffer.copy_to_bytes(buffer.remaining())))
    }
}

#[cfg(test)]
mod tests {
    use std::net::TcpListener;

    use super::*;
    use crate::{config::Config, service, status};

    #[test]
    fn an_answer_of_a_member_comes_through_whole() {
        let error = service::Error::IndexNotFound { name: "arm".into() };
        let expected = status::from_error(&error);
        let refused = refusal("a:1", &Status::from(expected.clone()));
        let NotForwarded::Refused { reason, status } = refused else {
            panic!("{refused:?}");
        };
        assert_eq!(reason, "INDEX_NOT_FOUND");
        let forwarded = service::Error::Forwarded { status };
        let forwarded = status::from_error(&forwarded);
        assert_eq!(forwarded.code, expected.code);
        assert_eq!(forwarded.to_message(), expected.to_message());
    }

    #[tokio::test]
    async fn only_a_member_that_does_not_answer_in_time_is_left_alone() {
        let channels = Channels::new(None, &Config::default().tls);
        let error = service::Error::IndexNotFound { name: "arm".into() };
        let answer = Status::from(status::from_error(&error));
        channels.note("a:1", &refusal("a:1", &answer), false);
        // The end of a deadline.
        let cut = refusal("a:1", &Status::cancelled("Timeout expired"));
        channels.note("a:1", &cut, true);
        assert!(channels.open.lock().is_empty());
        channels.note("a:1", &cut, false);
        assert!(matches!(
            channels.get("a:1", PAUSE).await,
            Err(NotForwarded::Unsent)
        ));
    }

    #[tokio::test]
    async fn a_member_that_is_left_alone_is_asked_what_it_alone_knows() {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let member = listener.local_addr().unwrap().to_string();
        let channels = Channels::new(None, &Config::default().tls);
        let lost = refusal(&member, &Status::unavailable("broken pipe"));
        channels.note(&member, &lost, false);
        assert!(channels.get(&member, PAUSE).await.is_err());
        channels.get(&member, Duration::ZERO).await.unwrap();
    }

    #[test]
    fn a_lost_connection_leaves_the_outcome_unknown() {
        let refused = refusal("a:1", &Status::unavailable("broken pipe"));
        assert!(matches!(refused, NotForwarded::Unknown { .. }));
    }
}
