//! The calls between the members of a cluster that no client sends, on the listener for members alone.
//!
//! They wait for no turn and count as no call: members trust each other, and the service bounds what is under way. A server
//! that stops does not wait for them either.

use std::{
    convert::Infallible,
    future::ready,
    pin::Pin,
    task::{Context, Poll},
};

use futures_util::{FutureExt, StreamExt, future::BoxFuture, stream};
use tonic::{
    Request, Response, Status,
    body::Body,
    server::{Grpc, NamedService, ServerStreamingService, UnaryService},
};
use tonic_prost::ProstCodec;

use super::status::{Answer, Messages, from_error, respond};
use crate::service::{
    COPY, CopyOutcome, CopyPart, CopyRequest, IndexCopy, SERVICE, STORED, Service, StoredRequest,
    StoredResponse,
};

/// See the module.
#[derive(Clone)]
pub(crate) struct MemberFace {
    pub(crate) service: Service,
}

impl NamedService for MemberFace {
    const NAME: &'static str = SERVICE;
}

impl tower::Service<http::Request<Body>> for MemberFace {
    type Response = http::Response<Body>;
    type Error = Infallible;
    type Future = Pin<Box<dyn Future<Output = Result<http::Response<Body>, Infallible>> + Send>>;

    fn poll_ready(&mut self, _: &mut Context<'_>) -> Poll<Result<(), Infallible>> {
        Poll::Ready(Ok(()))
    }

    fn call(&mut self, request: http::Request<Body>) -> Self::Future {
        let face = self.clone();
        match request.uri().path() {
            COPY => Box::pin(async move {
                let mut grpc = Grpc::new(ProstCodec::<CopyPart, CopyRequest>::default());
                Ok(grpc.server_streaming(face, request).await)
            }),
            STORED => Box::pin(async move {
                let mut grpc = Grpc::new(ProstCodec::<StoredResponse, StoredRequest>::default());
                Ok(grpc.unary(face, request).await)
            }),
            _ => {
                let unknown = Status::unimplemented("no call of members has this name");
                Box::pin(ready(Ok(unknown.into_http())))
            }
        }
    }
}

impl UnaryService<StoredRequest> for MemberFace {
    type Response = StoredResponse;
    type Future = BoxFuture<'static, Answer<StoredResponse>>;

    fn call(&mut self, request: Request<StoredRequest>) -> Self::Future {
        let service = self.service.clone();
        async move { respond(service.stored(request.into_inner()).await) }.boxed()
    }
}

impl ServerStreamingService<CopyRequest> for MemberFace {
    type Response = CopyPart;
    type ResponseStream = Messages<CopyPart>;
    type Future = BoxFuture<'static, Answer<Self::ResponseStream>>;

    fn call(&mut self, request: Request<CopyRequest>) -> Self::Future {
        let service = self.service.clone();
        async move {
            let copying = service.copy_index(request.into_inner()).await;
            let parts = match copying.map_err(|error| from_error(&error))? {
                CopyOutcome::Copy(copy) => stream::unfold(copy, next).boxed(),
                CopyOutcome::None(kind) => {
                    let only = CopyPart { kind: Some(kind) };
                    stream::once(ready(Ok(only))).boxed()
                }
            };
            Ok(Response::new(parts))
        }
        .boxed()
    }
}

/// The next part, made when the member has room for it.
async fn next(mut copy: Box<IndexCopy>) -> Option<(Result<CopyPart, Status>, Box<IndexCopy>)> {
    let part = copy.next().await?;
    Some((part.map_err(|error| from_error(&error)), copy))
}
