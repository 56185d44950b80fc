//! The calls to the other members of a cluster: the mutations that the owner of an index evaluates, and the calls of
//! [`member_service`](super::member_service).

mod channels;

use std::{path::Path, time::Instant};

use bytes::Bytes;
use futures_util::StreamExt;
use http::{HeaderMap, HeaderValue, uri::PathAndQuery};
use tonic::{Request, client::Grpc, metadata::MetadataMap, transport::Channel};
use tonic_prost::ProstCodec;

use self::channels::{Channels, Raw, refusal};
use super::calls::IDENTITY;
use crate::{
    config::TlsConfig,
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

    /// Sends a mutation, encoded already, in the name of its caller.
    pub(crate) async fn forward(
        &self,
        member: &str,
        rpc: &'static str,
        call: &Call,
        request: Bytes,
    ) -> Result<Bytes, NotForwarded> {
        let mut channel = self.channels.get(member).await?;
        let mut headers = HeaderMap::new();
        let unsent = |_| NotForwarded::Unsent;
        if let Some(name) = call.caller.name() {
            headers.insert(IDENTITY, HeaderValue::from_str(name).map_err(unsent)?);
        }
        if let Some(trace) = &call.trace {
            headers.insert("traceparent", HeaderValue::from_str(trace).map_err(unsent)?);
        }
        let metadata = MetadataMap::from_headers(headers);
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

    /// The connection to a member, for a call that only members send.
    async fn channel(&self, member: &str) -> Result<Grpc<Channel>, Unanswered> {
        let channel = self.channels.get(member).await;
        let mut channel = channel.map_err(|_| Unanswered {
            what: "it cannot be reached".into(),
        })?;
        channel.ready().await.map_err(unanswered)?;
        Ok(channel)
    }
}

fn unanswered(error: impl std::error::Error) -> Unanswered {
    Unanswered {
        what: error.to_string(),
    }
}
