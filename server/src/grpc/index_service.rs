//! `wayfold.v1.IndexService`, translated to calls of the service and back.

use futures_util::{StreamExt, stream, stream::BoxStream};
use tonic::{Request, Response, Status, Streaming};
use wayfold_proto::v1::{self, index_service_server::IndexService};

use super::{calls::call_of, refusals};
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
    async fn create_index(
        &self,
        request: Request<v1::CreateIndexRequest>,
    ) -> Result<Response<v1::CreateIndexResponse>, Status> {
        let (call, message) = (call_of(&request), request.into_inner());
        observe::index(&message.name);
        status::respond(self.service.create_index(&call, message).await)
    }

    async fn get_index(
        &self,
        request: Request<v1::GetIndexRequest>,
    ) -> Result<Response<v1::GetIndexResponse>, Status> {
        let (call, message) = (call_of(&request), request.into_inner());
        observe::index(&message.name);
        status::respond(self.service.get_index(&call, message).await)
    }

    async fn list_indexes(
        &self,
        request: Request<v1::ListIndexesRequest>,
    ) -> Result<Response<v1::ListIndexesResponse>, Status> {
        let (call, message) = (call_of(&request), request.into_inner());
        let listed = self.service.list_indexes(&call, message).await;
        status::respond(listed.map(status::listing))
    }

    async fn delete_index(
        &self,
        request: Request<v1::DeleteIndexRequest>,
    ) -> Result<Response<v1::DeleteIndexResponse>, Status> {
        let (call, message) = (call_of(&request), request.into_inner());
        observe::index(&message.name);
        status::respond(self.service.delete_index(&call, message).await)
    }
    type SnapshotIndexStream = BoxStream<'static, Result<v1::SnapshotIndexResponse, Status>>;

    async fn snapshot_index(
        &self,
        request: Request<v1::SnapshotIndexRequest>,
    ) -> Result<Response<Self::SnapshotIndexStream>, Status> {
        let (call, message) = (call_of(&request), request.into_inner());
        observe::index(&message.name);
        let snapshot = self.service.snapshot_index(&call, message).await;
        let snapshot = snapshot.map_err(|error| status::from_error(&error))?;
        // A part is made when the client has room for it, not before.
        let parts = stream::unfold(snapshot, async |mut snapshot| {
            let part = snapshot.next().await?;
            Some((part.map_err(|error| status::from_error(&error)), snapshot))
        });
        Ok(Response::new(parts.boxed()))
    }

    async fn restore_index(
        &self,
        request: Request<Streaming<v1::RestoreIndexRequest>>,
    ) -> Result<Response<v1::RestoreIndexResponse>, Status> {
        let (call, mut messages) = (call_of(&request), request.into_inner());
        let restoring = self.service.restore_index(&call);
        let mut restoring = restoring.map_err(|error| status::from_error(&error))?;
        let restate = |status| refusals::restate(status, self.max_message_bytes, refusals::RAISE);
        while let Some(message) = messages.message().await.map_err(restate)? {
            if !message.name.is_empty() {
                observe::index(&message.name);
            }
            let added = restoring.add(message).await;
            added.map_err(|error| status::from_error(&error))?;
        }
        status::respond(restoring.finish().await)
    }

    type VerifyIndexStream = BoxStream<'static, Result<v1::VerifyIndexResponse, Status>>;

    async fn verify_index(
        &self,
        request: Request<v1::VerifyIndexRequest>,
    ) -> Result<Response<Self::VerifyIndexStream>, Status> {
        let (call, message) = (call_of(&request), request.into_inner());
        observe::index(&message.name);
        let verification = self.service.verify_index(&call, message).await;
        let verification = verification.map_err(|error| status::from_error(&error))?;
        let answers = stream::unfold(verification, async |mut verification| {
            let answer = verification.next().await?;
            Some((
                answer.map_err(|error| status::from_error(&error)),
                verification,
            ))
        });
        Ok(Response::new(answers.boxed()))
    }
}
