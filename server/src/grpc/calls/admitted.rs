//! A call that may wait for its turns: its request arrives, and then it is answered.

use std::{
    convert::Infallible, future::poll_fn, mem, pin::Pin, sync::Arc, task::Poll, time::Instant,
};

use bytes::Bytes;
use http::{Request, Response};
use http_body::Body as HttpBody;
use http_body_util::Full;
use tonic::{Status, body::Body};

use crate::{
    admission::HeldBytes,
    grpc::{
        body::AnswerFrame,
        connections::Activity,
        refusals,
        request_body::{HEADER_BYTES, RequestBody, RequestLimits},
    },
    service::{Call, Service},
    status, verbs,
};

const WRITE: &str = "/wayfold.v1.PointService/Write";

/// A call that may wait for its turns.
pub(super) struct Admitted<S> {
    pub(super) inner: S,
    pub(super) limits: RequestLimits,
    pub(super) held: Arc<HeldBytes>,
    pub(super) arrived: Instant,
    pub(super) call: Call,
    /// True if its request is a stream.
    pub(super) is_stream: bool,
    pub(super) service: Service,
    /// The request, unless it is a stream.
    pub(super) whole: Bytes,
}

impl<S> Admitted<S>
where
    S: tower::Service<Request<Body>, Response = Response<Body>, Error = Infallible>,
{
    /// Receives the request.
    pub(super) async fn receive(
        mut self,
        mut request: Request<Body>,
    ) -> Result<(Self, Request<Body>), Status> {
        request.extensions_mut().insert(self.call.clone());
        request
            .extensions_mut()
            .insert(Arc::clone(self.held.flow()));
        let activity = request.extensions().get::<Activity>().cloned();
        let (parts, body) = request.into_parts();
        let held = Arc::clone(&self.held);
        let (is_stream, arrived) = (self.is_stream, self.arrived);
        let body = RequestBody::new(body, self.limits, held, activity, is_stream, arrived);
        let body = match self.is_stream {
            true => Body::new(body),
            false => {
                self.whole = body.whole().await.map_err(unless_left)?;
                Body::empty()
            }
        };
        Ok((self, Request::from_parts(parts, body)))
    }

    /// Answers the request, and makes the first frame of the answer if that can be done at once.
    pub(super) async fn answer(
        mut self,
        mut request: Request<Body>,
    ) -> Result<(Response<Body>, Option<AnswerFrame>), Status> {
        if !self.held.has_room() {
            return Err(status::too_many_bytes(self.held.flow().max_bytes()).into());
        }
        if !self.is_stream {
            let message = self.whole.get(HEADER_BYTES..).unwrap_or_default();
            let is_write = request.uri().path() == WRITE;
            let limits = self.service.limits();
            if let Err(error) = verbs::check_fields(message, is_write, limits) {
                return Err(status::from_error(&error).into());
            }
            *request.body_mut() = Body::new(Full::new(mem::take(&mut self.whole)));
        }
        let response = match self.inner.call(request).await {
            Ok(response) => response,
            Err(never) => match never {},
        };
        let mut response = refusals::rewrite(response, self.limits.message);
        let body = response.body_mut();
        let first = poll_fn(|context| Poll::Ready(Pin::new(&mut *body).poll_frame(context)));
        let made = match first.await {
            Poll::Ready(made) => made,
            Poll::Pending => None,
        };
        Ok((response, made))
    }
}

/// Our own refusal of a request, or the end of a call whose client cut it: that is no fault of the server.
fn unless_left(status: Status) -> Status {
    match status.details().is_empty() {
        true => Status::cancelled("the request was cut"),
        false => status,
    }
}
