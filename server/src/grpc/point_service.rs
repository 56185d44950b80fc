//! `wayfold.v1.PointService`, translated to calls of the service and back.

use std::{
    convert::Infallible,
    pin::Pin,
    task::{Context, Poll},
};

use tonic::{Request, Status, Streaming, body::Body, server::NamedService};
use wayfold_proto::v1::{
    self,
    point_service_server::{PointService, PointServiceServer},
};

use super::{
    calls::{flow_of, into_call},
    status::{Answer, Messages, respond, respond_all},
    stream_knn::{Answers, KnnStreams},
};
use crate::service::Service;

/// The gRPC face of the points.
#[derive(Clone)]
struct PointFace {
    service: Service,
}

#[tonic::async_trait]
impl PointService for PointFace {
    async fn insert(&self, request: Request<v1::InsertRequest>) -> Answer<v1::InsertResponse> {
        let (call, message) = into_call(request);
        respond(self.service.insert(&call, message).await)
    }

    async fn update(&self, request: Request<v1::UpdateRequest>) -> Answer<v1::UpdateResponse> {
        let (call, message) = into_call(request);
        respond(self.service.update(&call, message).await)
    }

    async fn remove(&self, request: Request<v1::RemoveRequest>) -> Answer<v1::RemoveResponse> {
        let (call, message) = into_call(request);
        respond(self.service.remove(&call, message).await)
    }

    async fn open_session(
        &self,
        request: Request<v1::OpenSessionRequest>,
    ) -> Answer<v1::OpenSessionResponse> {
        let (call, message) = into_call(request);
        respond(self.service.open_session(&call, message).await)
    }

    async fn write(&self, request: Request<v1::WriteRequest>) -> Answer<v1::WriteResponse> {
        let (call, message) = into_call(request);
        respond(self.service.write(&call, message).await)
    }

    async fn get(&self, request: Request<v1::GetRequest>) -> Answer<v1::GetResponse> {
        let (call, message) = into_call(request);
        respond(self.service.get(&call, message).await)
    }

    async fn knn(&self, request: Request<v1::KnnRequest>) -> Answer<v1::KnnResponse> {
        let (call, message) = into_call(request);
        respond(self.service.knn(&call, message).await)
    }

    async fn query(&self, request: Request<v1::QueryRequest>) -> Answer<v1::QueryResponse> {
        let (call, message) = into_call(request);
        respond(self.service.query(&call, message).await)
    }

    type StreamKnnStream = Answers;

    /// Never reached: see [`TolerantPointServer`].
    async fn stream_knn(&self, _: Request<Streaming<v1::StreamKnnRequest>>) -> Answer<Answers> {
        Err(Status::unimplemented("KnnStreams serves this call"))
    }

    type ScanStream = Messages<v1::ScanResponse>;

    async fn scan(&self, request: Request<v1::ScanRequest>) -> Answer<Self::ScanStream> {
        let flow = flow_of(&request);
        let (call, message) = into_call(request);
        respond_all(flow, self.service.scan(&call, message).await)
    }

    type WatchStream = Messages<v1::WatchResponse>;

    async fn watch(&self, request: Request<v1::WatchRequest>) -> Answer<Self::WatchStream> {
        let flow = flow_of(&request);
        let (call, message) = into_call(request);
        let watch = self.service.watch(&call, message).await;
        let watch = watch.map(|watch| match &flow {
            Some(flow) => watch.with_read_ahead(flow.hold()),
            None => watch,
        });
        respond_all(flow, watch)
    }
}

const STREAM_KNN: &str = "/wayfold.v1.PointService/StreamKnn";

/// The generated server, except that `StreamKnn` goes to [`KnnStreams`] with its messages unparsed.
#[derive(Clone)]
pub(crate) struct TolerantPointServer {
    generated: PointServiceServer<PointFace>,
    streams: KnnStreams,
}

impl TolerantPointServer {
    /// Serves the points of the service of `streams`.
    pub(crate) fn new(streams: KnnStreams) -> Self {
        let service = streams.service.clone();
        let generated = PointServiceServer::new(PointFace { service })
            .max_decoding_message_size(streams.max_message_bytes);
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
