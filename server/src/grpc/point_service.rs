//! `wayfold.v1.PointService`, translated to calls of the service and back.

use std::{
    convert::Infallible,
    pin::Pin,
    task::{Context, Poll},
};

use futures_util::{StreamExt, stream, stream::BoxStream};
use tonic::{Request, Response, Status, Streaming, body::Body, server::NamedService};
use wayfold_proto::v1::{
    self,
    point_service_server::{PointService, PointServiceServer},
};

use super::{
    calls::call_of,
    stream_knn::{Answers, KnnStreams},
};
use crate::{observe, service::Service, status};

/// The gRPC face of the points.
#[derive(Clone)]
pub(crate) struct PointFace {
    pub(crate) service: Service,
    pub(crate) streams: KnnStreams,
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

    /// Reached only where the generated server stands alone: see [`TolerantPointServer`].
    async fn stream_knn(
        &self,
        request: Request<Streaming<v1::StreamKnnRequest>>,
    ) -> Result<Response<Answers>, Status> {
        let call = call_of(&request);
        let messages = request.into_inner().map(|message| message.map(Ok));
        Ok(Response::new(self.streams.answer(call, messages)))
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

    type WatchStream = BoxStream<'static, Result<v1::WatchResponse, Status>>;

    async fn watch(
        &self,
        request: Request<v1::WatchRequest>,
    ) -> Result<Response<Self::WatchStream>, Status> {
        let (call, message) = (call_of(&request), request.into_inner());
        observe::index(&message.index);
        let watch = self.service.watch(&call, message).await;
        let watch = watch.map_err(|error| status::from_error(&error))?;
        let messages = stream::unfold(watch, async |mut watch| {
            let message = watch.next().await?;
            Some((message.map_err(|error| status::from_error(&error)), watch))
        });
        Ok(Response::new(messages.boxed()))
    }
}

const STREAM_KNN: &str = "/wayfold.v1.PointService/StreamKnn";

/// The generated server, but for `StreamKnn`, which goes to [`KnnStreams`] with its messages unparsed.
#[derive(Clone)]
pub(crate) struct TolerantPointServer {
    generated: PointServiceServer<PointFace>,
    streams: KnnStreams,
}

impl TolerantPointServer {
    /// Serves `face`.
    pub(crate) fn new(face: PointFace) -> Self {
        let streams = face.streams.clone();
        let generated =
            PointServiceServer::new(face).max_decoding_message_size(streams.max_message_bytes);
        Self { generated, streams }
    }
}

impl NamedService for TolerantPointServer {
    const NAME: &'static str = <PointServiceServer<PointFace> as NamedService>::NAME;
}

impl tower::Service<http::Request<Body>> for TolerantPointServer {
    type Response = http::Response<Body>;
    type Error = Infallible;
    type Future = Pin<Box<dyn Future<Output = Result<http::Response<Body>, Infallible>> + Send>>;

    fn poll_ready(&mut self, context: &mut Context<'_>) -> Poll<Result<(), Infallible>> {
        tower::Service::<http::Request<Body>>::poll_ready(&mut self.generated, context)
    }

    fn call(&mut self, request: http::Request<Body>) -> Self::Future {
        if request.uri().path() != STREAM_KNN {
            return tower::Service::call(&mut self.generated, request);
        }
        let streams = self.streams.clone();
        Box::pin(async move { Ok(streams.serve(request).await) })
    }
}
