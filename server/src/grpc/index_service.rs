//! `wayfold.v1.IndexService`, translated to calls of the service and back.

use std::mem;

use tonic::{Request, Streaming};
use wayfold_proto::v1::{self, index_service_server::IndexService};

use super::{
    calls::{call_of, caller_checks, check_caller, flow_of, into_call},
    refusals::{self, MessageLimit},
    status::{Answer, Messages, from_error, respond, respond_all},
};
use crate::{observe, service::Service, status};

/// The gRPC face of the indices.
#[derive(Clone)]
pub(crate) struct IndexFace {
    pub(crate) service: Service,
    /// The largest request message that is read.
    pub(crate) max_message_bytes: usize,
}

#[tonic::async_trait]
impl IndexService for IndexFace {
    async fn get_server(
        &self,
        request: Request<v1::GetServerRequest>,
    ) -> Answer<v1::GetServerResponse> {
        let (call, message) = into_call(request);
        let described = self
            .service
            .get_server(&call, message, self.max_message_bytes);
        respond(described.await)
    }

    async fn create_index(
        &self,
        request: Request<v1::CreateIndexRequest>,
    ) -> Answer<v1::CreateIndexResponse> {
        let (call, message) = into_call(request);
        respond(self.service.create_index(&call, message).await)
    }

    async fn get_index(
        &self,
        request: Request<v1::GetIndexRequest>,
    ) -> Answer<v1::GetIndexResponse> {
        let (call, message) = into_call(request);
        respond(self.service.get_index(&call, message).await)
    }

    async fn list_indexes(
        &self,
        request: Request<v1::ListIndexesRequest>,
    ) -> Answer<v1::ListIndexesResponse> {
        let (call, message) = into_call(request);
        let listed = self.service.list_indexes(&call, message).await;
        respond(listed.map(status::listing))
    }

    async fn delete_index(
        &self,
        request: Request<v1::DeleteIndexRequest>,
    ) -> Answer<v1::DeleteIndexResponse> {
        let (call, message) = into_call(request);
        respond(self.service.delete_index(&call, message).await)
    }

    type SnapshotIndexStream = Messages<v1::SnapshotIndexResponse>;

    async fn snapshot_index(
        &self,
        request: Request<v1::SnapshotIndexRequest>,
    ) -> Answer<Self::SnapshotIndexStream> {
        let flow = flow_of(&request);
        let (call, message) = into_call(request);
        respond_all(flow, self.service.snapshot_index(&call, message).await)
    }

    async fn restore_index(
        &self,
        request: Request<Streaming<v1::RestoreIndexRequest>>,
    ) -> Answer<v1::RestoreIndexResponse> {
        let (call, mut messages) = (call_of(&request), request.into_inner());
        let restoring = self.service.restore_index(&call);
        let mut restoring = restoring.map_err(|error| from_error(&error))?;
        let limit = MessageLimit::of_setting(self.max_message_bytes);
        let restate =
            |status| refusals::unless_left(refusals::restate(status, limit, refusals::RAISE));
        let (mut checks, mut is_observed) = (caller_checks(), false);
        loop {
            let message = tokio::select! {
                biased;
                message = messages.message() => message.map_err(restate)?,
                _ = checks.tick() => {
                    check_caller(&call)?;
                    continue;
                }
            };
            let Some(message) = message else { break };
            if !mem::replace(&mut is_observed, true) {
                observe::request(&message);
            }
            let added = restoring.add(message).await;
            added.map_err(|error| from_error(&error))?;
        }
        respond(restoring.finish().await)
    }

    type VerifyIndexStream = Messages<v1::VerifyIndexResponse>;

    async fn verify_index(
        &self,
        request: Request<v1::VerifyIndexRequest>,
    ) -> Answer<Self::VerifyIndexStream> {
        let flow = flow_of(&request);
        let (call, message) = into_call(request);
        respond_all(flow, self.service.verify_index(&call, message).await)
    }
}
