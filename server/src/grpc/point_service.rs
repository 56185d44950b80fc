//! `wayfold.v1.PointService`, translated to calls of the service and back.

use futures_util::{StreamExt, stream, stream::BoxStream};
use tonic::{Request, Response, Status, Streaming};
use wayfold_proto::v1::{self, point_service_server::PointService};

use super::{calls::Deadline, status, stream_knn::Answers};
use crate::{
    lifecycle::PhaseWatch,
    observe,
    service::{Call, Service},
};

/// The gRPC face of the points.
#[derive(Clone)]
pub(crate) struct PointFace {
    pub(crate) service: Service,
    pub(crate) phases: PhaseWatch,
    /// How many requests of one `StreamKnn` are evaluated at a time.
    pub(crate) stream_window: usize,
    /// The largest request message that is read.
    pub(crate) max_message_bytes: usize,
}

/// What the service is to know of a call.
pub(crate) fn call_of<T>(request: &Request<T>) -> Call {
    Call {
        deadline: request
            .extensions()
            .get::<Deadline>()
            .and_then(|deadline| deadline.0),
    }
}

fn state_rows(states: Option<&v1::States>) -> usize {
    states.map_or(0, |states| states.rows as usize)
}

#[tonic::async_trait]
impl PointService for PointFace {
    async fn insert(
        &self,
        request: Request<v1::InsertRequest>,
    ) -> Result<Response<v1::InsertResponse>, Status> {
        let (call, message) = (call_of(&request), request.into_inner());
        observe::index(&message.index);
        observe::rows(state_rows(message.states.as_ref()));
        status::respond(self.service.insert(&call, message).await)
    }

    async fn update(
        &self,
        request: Request<v1::UpdateRequest>,
    ) -> Result<Response<v1::UpdateResponse>, Status> {
        let (call, message) = (call_of(&request), request.into_inner());
        observe::index(&message.index);
        observe::rows(message.ids.len());
        status::respond(self.service.update(&call, message).await)
    }

    async fn remove(
        &self,
        request: Request<v1::RemoveRequest>,
    ) -> Result<Response<v1::RemoveResponse>, Status> {
        let (call, message) = (call_of(&request), request.into_inner());
        observe::index(&message.index);
        observe::rows(message.ids.len());
        status::respond(self.service.remove(&call, message).await)
    }

    async fn get(
        &self,
        request: Request<v1::GetRequest>,
    ) -> Result<Response<v1::GetResponse>, Status> {
        let (call, message) = (call_of(&request), request.into_inner());
        observe::index(&message.index);
        observe::rows(message.ids.len());
        status::respond(self.service.get(&call, message).await)
    }

    async fn knn(
        &self,
        request: Request<v1::KnnRequest>,
    ) -> Result<Response<v1::KnnResponse>, Status> {
        let (call, message) = (call_of(&request), request.into_inner());
        observe::index(&message.index);
        observe::rows(state_rows(message.states.as_ref()));
        status::respond(self.service.knn(&call, message).await)
    }

    async fn query(
        &self,
        request: Request<v1::QueryRequest>,
    ) -> Result<Response<v1::QueryResponse>, Status> {
        let (call, message) = (call_of(&request), request.into_inner());
        observe::index(&message.index);
        observe::rows(state_rows(message.states.as_ref()));
        status::respond(self.service.query(&call, message).await)
    }

    type StreamKnnStream = Answers;

    /// Reached only where the generated server stands alone: see [`super::stream_knn`].
    async fn stream_knn(
        &self,
        request: Request<Streaming<v1::StreamKnnRequest>>,
    ) -> Result<Response<Answers>, Status> {
        let call = call_of(&request);
        let messages = request.into_inner().map(|message| message.map(Ok));
        Ok(Response::new(self.answer(call, messages)))
    }

    type ScanStream = BoxStream<'static, Result<v1::ScanResponse, Status>>;

    async fn scan(
        &self,
        request: Request<v1::ScanRequest>,
    ) -> Result<Response<Self::ScanStream>, Status> {
        let (call, message) = (call_of(&request), request.into_inner());
        observe::index(&message.index);
        let scan = self.service.scan(&call, message).await;
        let scan = scan.map_err(|error| status::from_error(&error))?;
        // A part is made when the client has room for it, not before.
        let parts = stream::unfold(scan, async |mut scan| {
            let part = scan.next().await?;
            Some((part.map_err(|error| status::from_error(&error)), scan))
        });
        Ok(Response::new(parts.boxed()))
    }
}
