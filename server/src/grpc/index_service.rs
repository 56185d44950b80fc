//! `wayfold.v1.IndexService`, translated to calls of the service and back.

use tonic::{Request, Response, Status};
use wayfold_proto::v1::{self, index_service_server::IndexService};

use super::{calls::call_of, status};
use crate::{observe, service::Service};

/// The gRPC face of the indices.
#[derive(Clone)]
pub(crate) struct IndexFace(pub(crate) Service);

#[tonic::async_trait]
impl IndexService for IndexFace {
    async fn create_index(
        &self,
        request: Request<v1::CreateIndexRequest>,
    ) -> Result<Response<v1::CreateIndexResponse>, Status> {
        let (call, message) = (call_of(&request), request.into_inner());
        observe::index(&message.name);
        status::respond(self.0.create_index(&call, message).await)
    }

    async fn get_index(
        &self,
        request: Request<v1::GetIndexRequest>,
    ) -> Result<Response<v1::GetIndexResponse>, Status> {
        let (call, message) = (call_of(&request), request.into_inner());
        observe::index(&message.name);
        status::respond(self.0.get_index(&call, message).await)
    }

    async fn list_indexes(
        &self,
        request: Request<v1::ListIndexesRequest>,
    ) -> Result<Response<v1::ListIndexesResponse>, Status> {
        let (call, message) = (call_of(&request), request.into_inner());
        status::respond(self.0.list_indexes(&call, message).await)
    }

    async fn delete_index(
        &self,
        request: Request<v1::DeleteIndexRequest>,
    ) -> Result<Response<v1::DeleteIndexResponse>, Status> {
        let (call, message) = (call_of(&request), request.into_inner());
        observe::index(&message.name);
        status::respond(self.0.delete_index(&call, message).await)
    }
}
