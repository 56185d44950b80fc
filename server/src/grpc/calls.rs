//! The layer around every call: its span, deadline, share of the server's capacity, and the record of its end.
//!
//! Health and reflection pass through: they must answer just when the server is busy.

use std::{
    convert::Infallible,
    panic::AssertUnwindSafe,
    pin::Pin,
    task::{Context, Poll},
    time::Instant,
};

use futures_util::FutureExt;
use http::{Request, Response};
use tonic::body::Body;
use tower::{Layer, Service};
use tracing::Instrument;

use super::{
    body::{CallBody, Place},
    connections::Activity,
    deadline, refusals,
    request_body::{RequestBody, RequestLimits},
};
use crate::{
    admission::Admission,
    observe::{self, CallRecord, Ending},
    service::Call,
    status,
};

/// The calls that this layer is for.
const OURS: &str = "/wayfold.v1.";

/// The calls whose requests are streams.
const STREAMS: [&str; 2] = ["PointService/StreamKnn", "IndexService/RestoreIndex"];

/// The deadline of a call, which the layer leaves in the request's extensions for the handler.
#[derive(Clone, Copy, Debug)]
struct Deadline(Option<Instant>);

/// The service's context of a call.
pub(crate) fn call_of<T>(request: &tonic::Request<T>) -> Call {
    Call {
        deadline: request
            .extensions()
            .get::<Deadline>()
            .and_then(|deadline| deadline.0),
    }
}

/// The preamble of every handler: the context of the call, and its message, recorded in the call's span.
pub(crate) fn open<R: observe::Request>(request: tonic::Request<R>) -> (Call, R) {
    let (call, message) = (call_of(&request), request.into_inner());
    observe::request(&message);
    (call, message)
}

/// Wraps services in [`Calls`].
#[derive(Clone, Debug)]
pub(crate) struct CallsLayer {
    pub(crate) admission: Admission,
    pub(crate) max_message_bytes: usize,
    pub(super) requests: RequestLimits,
}

impl<S> Layer<S> for CallsLayer {
    type Service = Calls<S>;

    fn layer(&self, inner: S) -> Calls<S> {
        Calls {
            inner,
            settings: self.clone(),
        }
    }
}

/// See the module.
#[derive(Clone, Debug)]
pub(crate) struct Calls<S> {
    inner: S,
    settings: CallsLayer,
}

type ResponseFuture = Pin<Box<dyn Future<Output = Result<Response<Body>, Infallible>> + Send>>;

impl<S> Service<Request<Body>> for Calls<S>
where
    S: Service<Request<Body>, Response = Response<Body>, Error = Infallible>,
    S::Future: Send + 'static,
{
    type Response = Response<Body>;
    type Error = Infallible;
    type Future = ResponseFuture;

    fn poll_ready(&mut self, context: &mut Context<'_>) -> Poll<Result<(), Infallible>> {
        self.inner.poll_ready(context)
    }

    fn call(&mut self, mut request: Request<Body>) -> ResponseFuture {
        let activity = request.extensions().get::<Activity>().cloned();
        let active = match activity.as_ref().map(Activity::begin) {
            // The connection is being cut, and its calls with it.
            Some(None) => return Box::pin(std::future::pending()),
            begun => begun.flatten(),
        };
        let Some(rpc) = our_rpc(request.uri().path()) else {
            return Box::pin(self.inner.call(request));
        };
        // The clock starts here, not inside the future: after this function returns, tonic starts its own timer for the
        // same header and answers CANCELLED when it ends. Ours must never be the later one.
        let started = Instant::now();
        let is_stream = STREAMS.contains(&rpc);
        let mut record = CallRecord::begin(rpc, started);
        let admitted = deadline::read(request.headers(), started)
            .map_err(|problem| Box::new(refusals::malformed_timeout(&problem)))
            .and_then(|deadline| {
                let admission = &self.settings.admission;
                let busy = || Box::new(status::too_many_calls("grpc.max_calls", admission.limit()));
                let place = admission.take().ok_or_else(busy)?;
                Ok((deadline, place))
            });
        let (deadline, admitted) = match admitted {
            Ok(admitted) => admitted,
            Err(status) => {
                record.end(Ending::Failed(status.code));
                let refusal = tonic::Status::from(*status).into_http();
                return Box::pin(std::future::ready(Ok(refusal)));
            }
        };
        request.extensions_mut().insert(Deadline(deadline));
        let (parts, body) = request.into_parts();
        let requests = &self.settings.requests;
        let (body, held) = RequestBody::wrap(body, requests, activity, is_stream, started);
        let request = Request::from_parts(parts, body);
        let place = Place::new(admitted, active, held);
        let max_message_bytes = self.settings.max_message_bytes;
        let handler = AssertUnwindSafe(self.inner.call(request)).catch_unwind();
        let span = record.span().clone();
        let answer = async move {
            let outcome = match deadline {
                Some(at) => match tokio::time::timeout_at(at.into(), handler).await {
                    Ok(outcome) => outcome,
                    Err(_) => {
                        let status = tonic::Status::from(refusals::deadline_exceeded());
                        Ok(Ok(status.into_http()))
                    }
                },
                None => handler.await,
            };
            let response = match outcome {
                Ok(Ok(response)) => refusals::rewrite(response, max_message_bytes),
                Ok(Err(never)) => match never {},
                Err(_panic) => {
                    let status = tonic::Status::from(refusals::panicked(record.rpc()));
                    status.into_http()
                }
            };
            Ok(CallBody::wrap(response, record, place, deadline))
        };
        Box::pin(answer.instrument(span))
    }
}

/// `PointService/Knn` of `/wayfold.v1.PointService/Knn`; None for paths of other packages.
fn our_rpc(path: &str) -> Option<&str> {
    path.strip_prefix(OURS)
}

#[cfg(test)]
mod tests {
    use std::{sync::Arc, time::Duration};

    use futures_util::stream;
    use http_body::Body as HttpBody;
    use tonic::{Code, Status};
    use tonic_types::StatusExt;

    use super::*;
    use crate::admission::ByteBudget;

    /// Answers with the result of a function, or panics as it does.
    #[derive(Clone)]
    struct Answering(fn() -> Response<Body>);

    impl Service<Request<Body>> for Answering {
        type Response = Response<Body>;
        type Error = Infallible;
        type Future = ResponseFuture;

        fn poll_ready(&mut self, _: &mut Context<'_>) -> Poll<Result<(), Infallible>> {
            Poll::Ready(Ok(()))
        }

        fn call(&mut self, _: Request<Body>) -> ResponseFuture {
            let answer = self.0;
            Box::pin(async move { Ok(answer()) })
        }
    }

    async fn call(admission: &Admission, answer: fn() -> Response<Body>) -> Response<Body> {
        let layer = CallsLayer {
            admission: admission.clone(),
            max_message_bytes: 1000,
            requests: RequestLimits {
                all: Arc::new(ByteBudget::new(1000)),
                time: Duration::from_secs(1),
            },
        };
        let request = Request::post("/wayfold.v1.PointService/Knn").body(Body::empty());
        let answer = layer.layer(Answering(answer)).call(request.unwrap()).await;
        answer.unwrap()
    }

    #[tokio::test]
    async fn a_call_that_panics_is_a_bug_and_frees_its_place() {
        let admission = Admission::new(1);
        for _ in 0..2 {
            let answer = call(&admission, || panic!("a bug")).await;
            let status = Status::from_header_map(answer.headers()).unwrap();
            assert_eq!(status.code(), Code::Internal);
            assert_eq!(status.get_details_error_info().unwrap().reason, "INTERNAL");
            assert_eq!(admission.in_use(), 0);
        }
    }

    #[tokio::test]
    async fn a_stream_that_panics_ends_as_a_bug_and_frees_its_place() {
        let admission = Admission::new(1);
        let answer = call(&admission, || {
            let parts = stream::once(async { panic!("a bug") });
            let encoder = tonic_prost::ProstEncoder::<()>::default();
            let body = tonic::codec::EncodeBody::new_server(
                encoder,
                parts,
                None,
                Default::default(),
                None,
            );
            Response::new(Body::new(body))
        })
        .await;
        assert_eq!(admission.in_use(), 1);
        let mut body = answer.into_body();
        let frame = std::future::poll_fn(|context| Pin::new(&mut body).poll_frame(context)).await;
        let trailers = frame.unwrap().unwrap().into_trailers().unwrap();
        let status = Status::from_header_map(&trailers).unwrap();
        assert_eq!(status.code(), Code::Internal);
        assert_eq!(admission.in_use(), 0);
    }
}
