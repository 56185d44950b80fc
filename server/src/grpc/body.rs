//! A response body that enforces a stream's deadline and records its outcome.

use std::{
    panic::{AssertUnwindSafe, catch_unwind},
    pin::Pin,
    sync::Arc,
    task::{Context, Poll},
    time::Instant,
};

use bytes::Bytes;
use http::{HeaderMap, Response};
use http_body::{Body as HttpBody, Frame, SizeHint};
use tokio::{sync::OwnedSemaphorePermit, time::Sleep};
use tonic::{Code, Status, body::Body};

use super::{connections::ActiveCall, refusals, request_body::HeldBytes, status::ending};
use crate::observe::CallRecord;

/// A call's response body. It holds the call's place in the server's capacity until its end: a client that saw the end
/// finds the place free.
pub(crate) struct CallBody {
    inner: Body,
    record: CallRecord,
    deadline: Option<Instant>,
    /// Set at the body's first wait; the body of a unary answer never waits.
    timer: Option<Pin<Box<Sleep>>>,
    place: Option<Place>,
}

/// A call's places in the server's capacity and on its connection, and the bytes of its request.
pub(crate) struct Place {
    _admitted: OwnedSemaphorePermit,
    _active: Option<ActiveCall>,
    _held: Arc<HeldBytes>,
}

impl Place {
    pub(super) fn new(
        admitted: OwnedSemaphorePermit,
        active: Option<ActiveCall>,
        held: Arc<HeldBytes>,
    ) -> Self {
        Self {
            _admitted: admitted,
            _active: active,
            _held: held,
        }
    }
}

impl CallBody {
    /// Wraps the body of `response`; `record` ends with it.
    pub(crate) fn wrap(
        response: Response<Body>,
        mut record: CallRecord,
        place: Place,
        deadline: Option<Instant>,
    ) -> Response<Body> {
        if let Some(code) = code_in(response.headers()) {
            record.end(ending(code));
        }
        if response.body().is_end_stream() {
            return response;
        }
        response.map(|inner| {
            Body::new(Self {
                inner,
                record,
                deadline,
                timer: None,
                place: Some(place),
            })
        })
    }

    /// Ends the body with `status` and drops its source, which stops the work.
    fn end(&mut self, status: Status) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
        self.inner = Body::empty();
        self.ended(status.code());
        let mut trailers = HeaderMap::new();
        Poll::Ready(Some(match status.add_header(&mut trailers) {
            Ok(()) => Ok(Frame::trailers(trailers)),
            Err(status) => Err(status),
        }))
    }

    fn ended(&mut self, code: Code) {
        self.record.end(ending(code));
        self.place = None;
    }

    fn deadline_passed(&mut self, context: &mut Context<'_>) -> bool {
        let Some(deadline) = self.deadline else {
            return false;
        };
        let timer = self
            .timer
            .get_or_insert_with(|| Box::pin(tokio::time::sleep_until(deadline.into())));
        timer.as_mut().poll(context).is_ready()
    }
}

impl HttpBody for CallBody {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
        let this = &mut *self;
        let span = this.record.span().clone();
        let _entered = span.enter();
        let inner = Pin::new(&mut this.inner);
        let Ok(polled) = catch_unwind(AssertUnwindSafe(|| inner.poll_frame(context))) else {
            let status = refusals::panicked(this.record.rpc());
            return this.end(status.into());
        };
        match &polled {
            Poll::Pending if this.deadline_passed(context) => {
                let status = refusals::deadline_exceeded();
                return this.end(status.into());
            }
            Poll::Ready(Some(Ok(frame))) => {
                if let Some(code) = frame.trailers_ref().and_then(code_in) {
                    this.ended(code);
                }
            }
            Poll::Ready(Some(Err(status))) => this.ended(status.code()),
            Poll::Pending | Poll::Ready(None) => {}
        }
        polled
    }

    fn is_end_stream(&self) -> bool {
        self.inner.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.inner.size_hint()
    }
}

fn code_in(headers: &HeaderMap) -> Option<Code> {
    let status = headers.get(Status::GRPC_STATUS)?;
    Some(Code::from_bytes(status.as_bytes()))
}
