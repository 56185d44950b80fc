//! A response body that counts what its client has not read, enforces a stream's deadline while its client reads, and
//! records its outcome.

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
use tokio_util::task::task_tracker::TaskTrackerToken;
use tonic::{Code, Status, body::Body};

use super::{
    connections::{ActiveCall, Activity, PausedAnswer, Sending},
    status::ending,
};
use crate::{
    admission::{CallTurns, HeldBytes},
    faces,
    observe::CallRecord,
    status,
};

/// A frame of an answer.
pub(super) type AnswerFrame = Result<Frame<Bytes>, Status>;

/// A call's response body. It holds what the call holds until its end: a client that saw the end finds the resources free.
pub(crate) struct CallBody {
    inner: Body,
    /// A frame that was made with the answer's headers.
    made: Option<AnswerFrame>,
    record: CallRecord,
    deadline: Option<Instant>,
    /// Set at the body's first wait; the body of a unary answer never waits.
    timer: Option<Pin<Box<Sleep>>>,
    /// The turns in which the frames of a stream are made.
    turns: Option<CallTurns>,
    resources: Option<CallResources>,
    /// Set while the connection has a frame and has not asked for the next one.
    paused: Option<PausedAnswer>,
}

/// The resources of a call: its places on its connection and among the calls under way, and bytes.
pub(super) struct CallResources {
    pub(super) activity: Option<Activity>,
    pub(super) _active: Option<ActiveCall>,
    pub(super) _stream: Option<OwnedSemaphorePermit>,
    pub(super) _under_way: Option<TaskTrackerToken>,
    pub(super) held: Arc<HeldBytes>,
}

/// A frame that its client has not read. It is dropped once it is written.
struct UnreadFrame<H> {
    bytes: Bytes,
    _held: H,
    _sending: Option<Sending>,
}

impl<H> AsRef<[u8]> for UnreadFrame<H> {
    fn as_ref(&self) -> &[u8] {
        &self.bytes
    }
}

/// The bytes of a frame's buffer, which the encoder doubles while it grows.
pub(super) fn frame_bytes(bytes: usize) -> usize {
    bytes.next_power_of_two()
}

impl CallResources {
    /// Counts the buffer of `frame` until its client has read it.
    fn count(&self, frame: Frame<Bytes>) -> Frame<Bytes> {
        frame.map_data(|bytes| {
            let held = self.held.flow().hold();
            held.force_take(frame_bytes(bytes.len()));
            unread(bytes, held, self.activity.as_ref())
        })
    }
}

/// A frame's bytes, which hold `held` and count as unread on their connection until they are written.
pub(super) fn unread<H: Send + 'static>(
    bytes: Bytes,
    held: H,
    activity: Option<&Activity>,
) -> Bytes {
    let sending = activity.map(|it| it.send(frame_bytes(bytes.len())));
    Bytes::from_owner(UnreadFrame {
        bytes,
        _held: held,
        _sending: sending,
    })
}

impl CallBody {
    /// Wraps the body of `response`, of which a first frame may be `made`; `record` ends with it.
    pub(super) fn wrap(
        response: Response<Body>,
        made: Option<AnswerFrame>,
        mut record: CallRecord,
        resources: CallResources,
        deadline: Option<Instant>,
        turns: Option<CallTurns>,
    ) -> Response<Body> {
        if let Some(code) = code_in(response.headers()) {
            record.end(ending(code));
        }
        if made.is_none() && response.body().is_end_stream() {
            return response;
        }
        // It counts from now on, before the connection asks for it.
        let made = made.map(|made| made.map(|frame| resources.count(frame)));
        response.map(|inner| {
            Body::new(Self {
                inner,
                made,
                record,
                deadline,
                timer: None,
                turns,
                resources: Some(resources),
                paused: None,
            })
        })
    }

    /// The next frame, counted; made in a turn if the answer is a stream.
    fn poll_made(&mut self, context: &mut Context<'_>) -> Poll<Option<AnswerFrame>> {
        if let Some(made) = self.made.take() {
            return Poll::Ready(Some(made));
        }
        let inner = Pin::new(&mut self.inner);
        let make = |context: &mut Context<'_>| inner.poll_frame(context);
        let polled = catch_unwind(AssertUnwindSafe(|| match &mut self.turns {
            Some(turns) => turns.poll(context, make),
            None => make(context).map(Ok),
        }));
        match polled {
            Ok(Poll::Pending) => Poll::Pending,
            Ok(Poll::Ready(Ok(made))) => Poll::Ready(made.map(|made| {
                made.map(|frame| match &self.resources {
                    Some(resources) => resources.count(frame),
                    None => frame,
                })
            })),
            // It waited for its first turn for too long.
            Ok(Poll::Ready(Err(overloaded))) => self.end(status::overloaded(overloaded).into()),
            Err(_panic) => self.end(faces::panicked(self.record.rpc()).into()),
        }
    }

    /// Notes that the connection has a frame. It asks for the next once it can send this one.
    fn pause(&mut self) {
        let resources = self.resources.as_ref();
        let paused = resources.and_then(|it| Some((it.activity.as_ref()?, &it.held)));
        // The calls of administration hold none of the bytes that others need.
        let paused = paused.filter(|(activity, held)| Arc::ptr_eq(activity.flow(), held.flow()));
        self.paused = paused.map(|(activity, _)| activity.pause_answer());
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
        self.resources = None;
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
        this.paused = None;
        match this.poll_made(context) {
            Poll::Pending if this.deadline_passed(context) => {
                this.end(faces::deadline_exceeded().into())
            }
            Poll::Ready(Some(Ok(frame))) => {
                match frame.trailers_ref().and_then(code_in) {
                    Some(code) => this.ended(code),
                    None => this.pause(),
                }
                Poll::Ready(Some(Ok(frame)))
            }
            Poll::Ready(Some(Err(status))) => {
                this.ended(status.code());
                Poll::Ready(Some(Err(status)))
            }
            polled @ (Poll::Pending | Poll::Ready(None)) => polled,
        }
    }

    fn is_end_stream(&self) -> bool {
        self.made.is_none() && self.inner.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        match self.made {
            Some(_) => SizeHint::new(),
            None => self.inner.size_hint(),
        }
    }
}

fn code_in(headers: &HeaderMap) -> Option<Code> {
    let status = headers.get(Status::GRPC_STATUS)?;
    Some(Code::from_bytes(status.as_bytes()))
}
