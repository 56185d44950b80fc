//! The calls to the other members of a cluster: the mutations that the owner of an index evaluates, and the calls of
//! [`member_service`](super::member_service).

mod channels;

use std::{
    path::Path,
    time::{Duration, Instant},
};

use bytes::Bytes;
use futures_util::StreamExt;
use http::{HeaderMap, HeaderValue, uri::PathAndQuery};
use tonic::{Request, client::Grpc, metadata::MetadataMap, transport::Channel};
use tonic_prost::ProstCodec;

use self::channels::{Channels, PAUSE, Raw, refusal};
use super::calls::{CLIENT, IDENTITY, UID};
use crate::{
    config::TlsConfig,
    log::Uid,
    observe::trace_ids,
    service::{
        COPY, Call, CopyPart, CopyParts, CopyRequest, NotForwarded, STORED, StoredRequest,
        StoredResponse, Unanswered,
    },
};

/// See the module.
pub(crate) struct MemberClient {
    channels: Channels,
}

impl MemberClient {
    /// Calls with TLS if there are authorities of the members' certificates.
    pub(crate) fn new(peer_ca: Option<&Path>, tls: &TlsConfig) -> Self {
        let channels = Channels::new(peer_ca, tls);
        Self { channels }
    }

    /// Sends a mutation of the index with this uid, encoded already, in the name of its caller.
    pub(crate) async fn forward(
        &self,
        member: &str,
        uid: Uid,
        rpc: &'static str,
        call: &Call,
        request: Bytes,
    ) -> Result<Bytes, NotForwarded> {
        let mut channel = self.channels.get(member, PAUSE).await?;
        let metadata = MetadataMap::from_headers(headers(call, uid)?);
        let mut request = Request::from_parts(metadata, Default::default(), request);
        if let Some(deadline) = call.deadline {
            request.set_timeout(deadline.saturating_duration_since(Instant::now()));
        }
        let answered = match channel.ready().await {
            Ok(()) => {
                let answer = channel.unary(request, PathAndQuery::from_static(rpc), Raw);
                answer.await.map_err(|status| refusal(member, &status))
            }
            Err(_) => Err(NotForwarded::Unsent),
        };
        let is_late = call.deadline.is_some_and(|it| it <= Instant::now());
        if let Err(why) = &answered {
            self.channels.note(member, why, is_late);
        }
        Ok(answered?.into_inner())
    }

    /// Forgets a member that left.
    pub(crate) fn forget(&self, member: &str) {
        self.channels.forget(member);
    }

    /// Asks a member which revisions of some indices it stores.
    pub(crate) async fn stored(
        &self,
        member: &str,
        request: StoredRequest,
    ) -> Result<StoredResponse, Unanswered> {
        let mut channel = self.channel(member).await?;
        let codec = ProstCodec::<StoredRequest, StoredResponse>::default();
        let path = PathAndQuery::from_static(STORED);
        let answer = channel.unary(Request::new(request), path, codec).await;
        Ok(answer.map_err(unanswered)?.into_inner())
    }

    /// Asks a member for a copy of an index.
    pub(crate) async fn copy(
        &self,
        member: &str,
        request: CopyRequest,
    ) -> Result<CopyParts, Unanswered> {
        let mut channel = self.channel(member).await?;
        let codec = ProstCodec::<CopyRequest, CopyPart>::default();
        let path = PathAndQuery::from_static(COPY);
        let answer = channel.server_streaming(Request::new(request), path, codec);
        let parts = answer.await.map_err(unanswered)?.into_inner();
        Ok(parts.map(|part| part.map_err(unanswered)).boxed())
    }

    /// The connection to a member, for a call that only members send. No pause counts: no other member can answer for this one.
    async fn channel(&self, member: &str) -> Result<Grpc<Channel>, Unanswered> {
        let channel = self.channels.get(member, Duration::ZERO).await;
        let mut channel = channel.map_err(|_| Unanswered {
            what: "it cannot be reached".into(),
        })?;
        channel.ready().await.map_err(unanswered)?;
        Ok(channel)
    }
}

/// The headers of a forwarded call: the uid of its index, the identity of its caller, the number of its client, and its trace
/// unless that is malformed.
fn headers(call: &Call, uid: Uid) -> Result<HeaderMap, NotForwarded> {
    let mut headers = HeaderMap::new();
    let uid = HeaderValue::from_str(&uid.to_string());
    headers.insert(UID, uid.map_err(|_| NotForwarded::Unsent)?);
    if let Some(name) = call.caller.name() {
        let name = HeaderValue::from_bytes(name.as_bytes());
        headers.insert(IDENTITY, name.map_err(|_| NotForwarded::Unsent)?);
    }
    if let Some(permits) = &call.permits {
        headers.insert(CLIENT, permits.number().into());
    }
    let trace = call.trace.as_deref().filter(|it| trace_ids(it).is_some());
    if let Some(Ok(trace)) = trace.map(HeaderValue::from_str) {
        headers.insert("traceparent", trace);
    }
    Ok(headers)
}

fn unanswered(error: impl std::error::Error) -> Unanswered {
    Unanswered {
        what: error.to_string(),
    }
}

#[cfg(test)]
mod tests {
    use std::{fs, sync::Arc};

    use super::*;
    use crate::{grpc::calls::forwarded, identity::Identities, service::ClientPermits};

    #[test]
    fn a_name_beyond_ascii_and_a_malformed_trace_let_a_call_be_forwarded() {
        const NAME: &str = "Zelle-ü";
        const TRACE: &str = "00-4bf92f3577b34da6a3ce929d0e0e4736-00f067aa0ba902b7-01";
        let file = tempfile::NamedTempFile::new().unwrap();
        let entry = format!(
            "[[identity]]\nname = \"{NAME}\"\nrole = \"read\"\nindexes = []\ncertificate = \"cell\"\n"
        );
        fs::write(file.path(), entry).unwrap();
        let identities = Identities::open(Some(file.path())).unwrap();
        for (trace, sent) in [
            (TRACE, Some(TRACE)),
            ("malformed", None),
            ("00-\n", None),
            (
                "cc-4bf92f3577b34da6a3ce929d0e0e4736-00f067aa0ba902b7-01-\n",
                None,
            ),
        ] {
            let call = Call {
                caller: identities.forwarded(Some(NAME)),
                trace: Some(trace.into()),
                ..Call::default()
            };
            let headers = headers(&call, Uid::unique()).unwrap();
            assert_eq!(headers[IDENTITY].as_bytes(), NAME.as_bytes());
            let found = headers.get("traceparent").map(HeaderValue::as_bytes);
            assert_eq!(found, sent.map(str::as_bytes), "{trace}");
        }
    }

    #[test]
    fn the_owner_tells_the_clients_of_another_server_apart() {
        let [first, second] = [(); 2].map(|()| {
            let call = Call {
                permits: Some(Arc::new(ClientPermits::new(1))),
                ..Call::default()
            };
            let headers = headers(&call, Uid::unique()).unwrap();
            forwarded::<u64>(&headers, CLIENT).unwrap()
        });
        assert_ne!(first, second);
        let unknown = headers(&Call::default(), Uid::unique()).unwrap();
        assert_eq!(forwarded::<u64>(&unknown, CLIENT), None);
    }

    #[test]
    fn the_owner_gets_the_uid_of_the_index_of_a_forwarded_call() {
        let uid = Uid::unique();
        let headers = headers(&Call::default(), uid).unwrap();
        assert_eq!(forwarded::<Uid>(&headers, UID), Some(uid));
    }
}
