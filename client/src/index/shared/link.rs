//! The calls that a shared index makes, over gRPC, by a client, or over Zenoh (`zenoh`, `publications`).

mod load;
#[cfg(feature = "zenoh")]
mod publications;
#[cfg(feature = "zenoh")]
mod zenoh;

use std::{ops::Range, time::Duration};

use wayfold_index::Space;
use wayfold_proto::{
    space,
    v1::{self, PayloadEncoding, create_index_request::SpaceForm},
};

#[cfg(feature = "zenoh")]
use crate::RetryPolicy;
use crate::{
    Client, Code, Credentials, Error, Include, IndexHandle, IndexInfo, Limits, Points, Revision,
    ServerInfo, Watch,
    net::{
        call::Call,
        connections::Connection,
        limits::{READ_ROWS, read_in_parts},
    },
};

/// The address of a server.
#[derive(Clone, Debug)]
pub(super) enum Address {
    Grpc {
        uri: String,
    },
    #[cfg(feature = "zenoh")]
    Zenoh {
        session: ::zenoh::Session,
        prefix: String,
    },
}

/// The transport to the server, and the name of the index.
#[derive(Clone, Debug)]
pub(super) struct Link {
    name: String,
    /// The longest time of a call.
    timeout: Duration,
    transport: Transport,
}

#[derive(Clone, Debug)]
enum Transport {
    Grpc(Client),
    #[cfg(feature = "zenoh")]
    Zenoh(zenoh::ZenohLink),
}

impl Link {
    /// Reaches the server of the index of this name, and asks for its limits. A call waits for at most `timeout`.
    pub(super) async fn open(
        address: Address,
        name: &str,
        timeout: Duration,
        credentials: &Credentials,
    ) -> Result<(Link, Limits), Error> {
        let request = v1::GetServerRequest {};
        let (transport, answer) = match address {
            Address::Grpc { uri } => {
                let builder = Client::builder().timeout(timeout);
                let client = builder
                    .credentials(credentials.clone())
                    .connect(&uri)
                    .await?;
                let answer = client.send(timeout, &request).await?;
                (Transport::Grpc(client), answer)
            }
            #[cfg(feature = "zenoh")]
            Address::Zenoh { session, prefix } => {
                let link = zenoh::ZenohLink::new(session, (&prefix, name), timeout, credentials)?;
                // A session cannot tell a server that it has not found yet from one that is not there.
                let answer = link.call(&request, RetryPolicy::until_deadline()).await?;
                (Transport::Zenoh(link), answer)
            }
        };
        let server = ServerInfo::from_message(v1::GetServerRequest::NAME, answer)?;
        let link = Link {
            name: name.to_owned(),
            timeout,
            transport,
        };
        Ok((link, server.limits))
    }

    /// A link of a client that has asked its server for nothing.
    #[cfg(test)]
    pub(super) fn of_client(client: Client) -> Link {
        Link {
            name: "arm".to_owned(),
            timeout: Duration::from_secs(30),
            transport: Transport::Grpc(client),
        }
    }

    async fn call<C: Call>(&self, request: &C) -> Result<C::Answer, Error> {
        match &self.transport {
            Transport::Grpc(client) => client.send(self.timeout, request).await,
            #[cfg(feature = "zenoh")]
            Transport::Zenoh(link) => link.call(request, RetryPolicy::default()).await,
        }
    }

    /// The pause after this many failures in a row, the last with `error`.
    pub(super) fn pause(&self, failures: u32, error: Option<&Error>) -> Duration {
        let policy = match &self.transport {
            Transport::Grpc(client) => client.retry_policy(),
            #[cfg(feature = "zenoh")]
            Transport::Zenoh(_) => RetryPolicy::default(),
        };
        policy.endless_pause(failures, error)
    }

    /// True if another server may know better: this one has no index of the name, as one may that lags behind.
    pub(super) fn may_lag(&self, error: &Error) -> bool {
        let has_others = match &self.transport {
            Transport::Grpc(client) => client.connections().are_several(),
            // A prefix may be that of a cluster.
            #[cfg(feature = "zenoh")]
            Transport::Zenoh(_) => true,
        };
        has_others && error.code() == Code::NotFound
    }

    /// The connection that the next call uses, for [`Link::leave`]; none over Zenoh.
    pub(super) fn connection(&self) -> Option<Connection> {
        match &self.transport {
            Transport::Grpc(client) => Some(client.connection()),
            #[cfg(feature = "zenoh")]
            Transport::Zenoh(_) => None,
        }
    }

    /// Makes the next calls at another server than that of a connection, if there is one. The other task of the index may have
    /// left that server already.
    pub(super) fn leave(&self, asked: Option<&Connection>) {
        if let (Transport::Grpc(client), Some(asked)) = (&self.transport, asked) {
            client.connections().leave(asked);
        }
    }

    /// The limits that the server has now.
    pub(super) async fn limits(&self) -> Result<Limits, Error> {
        let answer = self.call(&v1::GetServerRequest {}).await?;
        let server = ServerInfo::from_message(v1::GetServerRequest::NAME, answer)?;
        Ok(server.limits)
    }

    /// The index that has the name now.
    pub(super) async fn index(&self) -> Result<IndexInfo, Error> {
        let request = v1::GetIndexRequest {
            index_name: self.name.clone(),
        };
        let answer = self.call(&request).await?;
        IndexInfo::from_message(v1::GetIndexRequest::NAME, answer.index)
    }

    /// Creates the index if it is missing.
    pub(super) async fn create(
        &self,
        space: &Space,
        payload_encoding: PayloadEncoding,
    ) -> Result<IndexInfo, Error> {
        let request = v1::CreateIndexRequest {
            name: self.name.clone(),
            space_form: Some(SpaceForm::Space(space::to_message(space))),
            payload_encoding: payload_encoding.into(),
        };
        let answer = self.call(&request).await?;
        IndexInfo::from_message(v1::CreateIndexRequest::NAME, answer.index)
    }

    /// Opens a writer session.
    pub(super) async fn open_session(
        &self,
        index: &IndexInfo,
        reserve_count: u64,
        operation_id: &str,
    ) -> Result<v1::OpenSessionResponse, Error> {
        let request = v1::OpenSessionRequest {
            index_name: index.name.clone(),
            uid: index.uid().to_string(),
            reserve_count,
            operation_id: operation_id.to_owned(),
        };
        self.call(&request).await
    }

    /// Writes a batch. Returns the ids it reserved and the number of the revision it made.
    pub(super) async fn write(
        &self,
        index: &IndexInfo,
        request: &v1::WriteRequest,
    ) -> Result<(Option<v1::IdBlock>, u64), Error> {
        let answer = self.call(request).await?;
        let revision =
            Revision::from_message(v1::WriteRequest::NAME, answer.revision, index.uid())?;
        Ok((answer.reserved, revision.number))
    }

    /// The payloads of points at revision `min_revision` or later ones, in the order of the ids; `None` for a point that
    /// is not stored.
    pub(super) async fn payloads(
        &self,
        index: &IndexInfo,
        min_revision: u64,
        ids: &[u64],
    ) -> Result<Vec<Option<Vec<u8>>>, Error> {
        let read = |part: Range<usize>| self.some_payloads(index, min_revision, &ids[part]);
        read_in_parts(ids.len(), READ_ROWS, read, |all, mut part| {
            all.append(&mut part);
        })
        .await
    }

    async fn some_payloads(
        &self,
        index: &IndexInfo,
        min_revision: u64,
        ids: &[u64],
    ) -> Result<Vec<Option<Vec<u8>>>, Error> {
        let mut stored = ids.to_vec();
        let payloads = loop {
            match self.stored_payloads(index, min_revision, &stored).await {
                // These points have been removed. The server names some of them.
                Err(Error::Refused(refusal))
                    if refusal.reason == "POINTS_NOT_FOUND"
                        && stored.iter().any(|id| refusal.ids.contains(id)) =>
                {
                    stored.retain(|id| !refusal.ids.contains(id));
                    if stored.is_empty() {
                        break Vec::new();
                    }
                }
                answer => break answer?,
            }
        };
        let mut found = stored.into_iter().zip(payloads).peekable();
        let payload = |id: &u64| found.next_if(|(stored, _)| stored == id).map(|it| it.1);
        Ok(ids.iter().map(payload).collect())
    }

    /// The payloads of points that are all stored.
    async fn stored_payloads(
        &self,
        index: &IndexInfo,
        min_revision: u64,
        ids: &[u64],
    ) -> Result<Vec<Vec<u8>>, Error> {
        let include = Include::none().payloads();
        let request = v1::GetRequest {
            index_name: index.name.clone(),
            ids: ids.to_vec(),
            include: include.to_message(),
            min_revision: Some(index.revision_at(min_revision).to_message()),
            latest: false,
        };
        let answer = self.call(&request).await?;
        let (call, width) = (v1::GetRequest::NAME, index.coordinate_count);
        let revision = Revision::from_message(call, answer.revision, index.uid())?;
        let points = Points::from_message(call, answer.points, revision, width, include)?;
        if points.ids() != ids {
            return Err(Error::protocol(
                call,
                "the points have other ids than the request",
            ));
        }
        let payload =
            |point: crate::Point<'_>| point.payload.cloned().map_or_else(Vec::new, Vec::from);
        Ok(points.iter().map(payload).collect())
    }

    /// Watches the index after a revision. The points that `own_session` stores may be left out.
    pub(super) async fn watch(
        &self,
        index: &std::sync::Arc<IndexInfo>,
        after: u64,
        own_session: u64,
    ) -> Result<Watch, Error> {
        match &self.transport {
            Transport::Grpc(client) => {
                let watch = handle(client, index, after).watch();
                let watch = watch.after(index.revision_at(after));
                watch.for_copy(own_session).await
            }
            #[cfg(feature = "zenoh")]
            Transport::Zenoh(link) => {
                publications::watch(link.clone(), index.clone(), after, own_session).await
            }
        }
    }
}

/// True if the same call may succeed later. So may one whose outcome is unknown: repeating a session's newest batch
/// does nothing twice. Damaged data stay damaged until an operator restores the index, which is another one then.
pub(super) fn is_transient(error: &Error) -> bool {
    match error {
        Error::Connection { .. }
        | Error::Handshake { .. }
        | Error::Timeout { .. }
        | Error::Protocol { .. } => true,
        Error::Refused(refusal) => {
            let may_end = matches!(
                refusal.code,
                Code::Unavailable
                    | Code::DeadlineExceeded
                    | Code::Internal
                    | Code::Unknown
                    | Code::Cancelled
            );
            may_end || error.retry_after().is_some()
        }
        _ => false,
    }
}

/// The handle of the index at `revision`.
fn handle(client: &Client, index: &IndexInfo, revision: u64) -> IndexHandle {
    let info = IndexInfo {
        revision: index.revision_at(revision),
        ..index.clone()
    };
    IndexHandle::new(client.clone(), info)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Refusal;

    #[test]
    fn a_refusal_is_final_unless_it_may_end_by_itself() {
        let transient = [
            Code::Unavailable,
            Code::DeadlineExceeded,
            Code::Internal,
            Code::Unknown,
            Code::Cancelled,
        ];
        for number in 1..=16 {
            let status = wayfold_proto::v1::Status {
                code: number,
                ..Default::default()
            };
            let refusal = Refusal::from_message(&status);
            let expected = transient.contains(&refusal.code);
            let error = Error::Refused(Box::new(refusal));
            assert_eq!(is_transient(&error), expected, "{number}");
        }
    }
}
