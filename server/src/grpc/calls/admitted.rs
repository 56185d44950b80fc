//! A call that may wait for its turns: its request arrives, and then it is answered.

use std::{
    convert::Infallible,
    future::poll_fn,
    mem,
    panic::AssertUnwindSafe,
    pin::{Pin, pin},
    sync::Arc,
    task::Poll,
    time::Instant,
};

use bytes::Bytes;
use futures_util::{FutureExt, poll};
use http::{Request, Response};
use http_body::Body as HttpBody;
use http_body_util::Full;
use tokio::time::timeout_at;
use tonic::{Status, body::Body};

use crate::{
    admission::{CallTurns, HeldBytes},
    faces,
    grpc::{
        body::{AnswerFrame, CallBody, CallResources, frame_bytes},
        connections::Activity,
        refusals,
        request_body::{HEADER_BYTES, RequestBody, RequestLimits},
        rpcs::Rpc,
    },
    observe::{CallRecord, SlowCalls, Times},
    request_bounds::check_fields,
    service::{Call, Service},
    status,
};

/// A call that may wait for its turns.
pub(super) struct Admitted<S> {
    pub(super) inner: S,
    pub(super) limits: RequestLimits,
    pub(super) held: Arc<HeldBytes>,
    pub(super) arrived: Instant,
    pub(super) call: Call,
    pub(super) rpc: Rpc,
    pub(super) service: Service,
    /// The request, unless it is a stream.
    pub(super) whole: Bytes,
}

impl<S> Admitted<S>
where
    S: tower::Service<Request<Body>, Response = Response<Body>, Error = Infallible>,
{
    /// Receives the request and answers it, unless the call's deadline passes before.
    pub(super) async fn run(
        self,
        request: Request<Body>,
        mut turns: CallTurns,
        mut record: CallRecord,
        resources: CallResources,
        slow_calls: SlowCalls,
    ) -> Result<Response<Body>, Infallible> {
        let (rpc, arrived, deadline) = (self.rpc, self.arrived, self.call.deadline);
        let mut received = None;
        let answer = async {
            let mut receiving = pin!(self.receive(request));
            let arriving = match poll!(receiving.as_mut()) {
                Poll::Ready(arrived) => arrived,
                Poll::Pending => {
                    // While its request still arrives, the call gives its turn to another.
                    turns.give_up();
                    receiving.await
                }
            };
            let (admitted, request) = arriving?;
            received = Some(arrived.elapsed());
            let done = turns.run(admitted.answer(request)).await;
            done.unwrap_or_else(|overloaded| Err(status::overloaded(overloaded).into()))
        };
        let answer = AssertUnwindSafe(answer).catch_unwind();
        let answered = match deadline {
            Some(at) => timeout_at(at.into(), answer).await,
            None => Ok(answer.await),
        };
        let answered = match answered {
            Ok(Ok(answered)) => answered,
            Ok(Err(_panic)) => Err(faces::panicked(record.rpc()).into()),
            Err(_) => Err(faces::deadline_exceeded().into()),
        };
        if rpc.is_unary() {
            let answered = arrived.elapsed();
            let (queued, computed) = turns.times();
            let times = Times {
                received: received.unwrap_or(answered),
                queued,
                computed,
                answered,
            };
            record.took(times, &slow_calls);
        }
        let (response, made) = answered.unwrap_or_else(|status: Status| (status.into_http(), None));
        let turns = rpc.streams_answers.then_some(turns);
        Ok(CallBody::wrap(
            response, made, record, resources, deadline, turns,
        ))
    }

    /// Receives the request.
    async fn receive(
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
        let (is_stream, arrived) = (self.rpc.streams_requests, self.arrived);
        let service = self.service.clone();
        let body = RequestBody::new(
            body,
            self.limits,
            held,
            activity,
            is_stream,
            arrived,
            service,
        );
        let body = match is_stream {
            true => Body::new(body),
            false => {
                self.whole = body.whole().await.map_err(refusals::unless_left)?;
                Body::empty()
            }
        };
        Ok((self, Request::from_parts(parts, body)))
    }

    /// Answers the request, and makes the first frame of the answer if that can be done at once.
    async fn answer(
        mut self,
        mut request: Request<Body>,
    ) -> Result<(Response<Body>, Option<AnswerFrame>), Status> {
        self.check_room(0)?;
        if !self.rpc.streams_requests {
            let message = self.whole.get(HEADER_BYTES..).unwrap_or_default();
            let is_write = self.rpc.verb == "write";
            let limits = self.service.limits();
            if let Err(error) = check_fields(message, is_write, limits) {
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
        // Only now its size is known. The answer to a mutation, which took place, is always given.
        if self.rpc.is_read()
            && let Some(Ok(frame)) = &made
            && let Some(bytes) = frame.data_ref()
        {
            self.check_room(frame_bytes(bytes.len()))?;
        }
        Ok((response, made))
    }

    fn check_room(&self, bytes: usize) -> Result<(), Status> {
        match self.held.check_room(bytes) {
            true => Ok(()),
            false => Err(status::too_many_bytes(self.held.flow().max_bytes()).into()),
        }
    }
}
