//! The body of a request on its way in: its bytes are counted, and its time is limited. A server that stops ends it if it is
//! not whole.
//!
//! A client that sends parts of messages holds memory of the server for as long as it likes. So all requests together
//! may hold a number of bytes, those of one connection a share of it, and a request must arrive in time.

use std::{
    pin::Pin,
    sync::Arc,
    task::{Context, Poll},
    time::{Duration, Instant},
};

use bytes::{Buf, Bytes};
use http_body::{Body as HttpBody, Frame, SizeHint};
use http_body_util::BodyExt;
use tokio::time::{Sleep, sleep_until};
use tokio_util::sync::WaitForCancellationFutureOwned;
use tonic::{Status, body::Body};

use super::{
    backlog::StreamBacklog,
    connections::{Activity, Waiting},
    refusals::{self, MessageLimit},
};
use crate::{admission::HeldBytes, service::Service, status};

/// Bytes before each message: a flag and the length.
pub(super) const HEADER_BYTES: usize = 5;

/// The most bytes that a request keeps ready for its next frames.
const MAX_SPARE_BYTES: usize = 64 * 1024;

/// The largest message, and the time in which each must arrive.
#[derive(Clone, Copy, Debug)]
pub(super) struct RequestLimits {
    pub(super) message: MessageLimit,
    /// The time of a request, and of each message of a stream.
    pub(super) time: Duration,
    /// True if the client of a stream may wait between two messages for as long as it likes.
    pub(super) may_pause: bool,
}

/// See the module.
pub(super) struct RequestBody {
    inner: Body,
    limits: RequestLimits,
    held: Arc<HeldBytes>,
    activity: Option<Activity>,
    /// True if the request is a stream. A stream that may pause holds only the bytes of the message that is arriving.
    is_stream: bool,
    /// The bytes of the largest message so far of a stream that may not pause. The stream holds them to its end: tonic keeps
    /// the buffer of that message, and a message may wait for long after it has arrived.
    largest: usize,
    /// That of a stream of a connection.
    backlog: Option<StreamBacklog<Status>>,
    messages: Messages,
    began: Instant,
    /// Set at the first wait for a message.
    timer: Option<Pin<Box<Sleep>>>,
    /// The bytes of a message at the last wait for the rest of it.
    waiting: Option<Waiting>,
    service: Service,
    /// Set at the first wait: the time at which the server begins to stop.
    stopping: Option<Pin<Box<WaitForCancellationFutureOwned>>>,
}

impl RequestBody {
    /// The body of a call of `service` on the connection of `activity` that began at `began`, and whose bytes are `held`.
    pub(super) fn new(
        inner: Body,
        limits: RequestLimits,
        held: Arc<HeldBytes>,
        activity: Option<Activity>,
        is_stream: bool,
        began: Instant,
        service: Service,
    ) -> Self {
        let streaming = activity.as_ref().filter(|_| is_stream);
        Self {
            inner,
            limits,
            backlog: streaming.map(|it| it.backlog().open()),
            held,
            activity,
            is_stream,
            largest: 0,
            messages: Messages::default(),
            began,
            timer: None,
            waiting: None,
            service,
            stopping: None,
        }
    }

    /// The bytes of a request that is no stream, in a buffer of their own. A frame of one byte would keep the buffer that
    /// it was read into.
    pub(super) async fn whole(mut self) -> Result<Bytes, Status> {
        let mut arrived = Arrived::default();
        while let Some(frame) = self.frame().await {
            if let Some(bytes) = frame?.data_ref() {
                arrived.push(bytes);
            }
        }
        Ok(arrived.join())
    }

    fn receive(&mut self, bytes: &Bytes) -> Result<(), Status> {
        if let Some(activity) = &self.activity {
            activity.note_arrival(bytes.len());
        }
        let before = (self.messages.unfinished, self.messages.ended);
        self.messages.advance(bytes);
        if before.0 == 0 || self.messages.ended > before.1 {
            self.timer = None;
            self.waiting = None;
        }
        let is_held = match self.is_stream {
            true if self.limits.may_pause => {
                self.held.release(before.0);
                self.held.take(self.messages.unfinished)
            }
            true => {
                let more = self.messages.newest_bytes().saturating_sub(self.largest);
                self.largest += more;
                more == 0 || self.held.take(more)
            }
            false if self.messages.length > self.limits.message.bytes => {
                return Err(refusals::too_large(self.limits.message, refusals::SPLIT).into());
            }
            false if self.messages.ended > u64::from(self.messages.are_whole()) => {
                return Err(refusals::malformed("another one follows it").into());
            }
            false => self.held.take(bytes.len()),
        };
        match is_held {
            true => Ok(()),
            false => Err(status::too_many_bytes(self.held.flow().max_bytes()).into()),
        }
    }

    fn is_stopping(&mut self, context: &mut Context<'_>) -> bool {
        let stopping = || Box::pin(self.service.stopping());
        let stopping = self.stopping.get_or_insert_with(stopping);
        stopping.as_mut().poll(context).is_ready()
    }

    fn is_late(&mut self, context: &mut Context<'_>) -> bool {
        if self.limits.may_pause && self.messages.are_whole() {
            return false;
        }
        // The time for which a stream was not read does not count.
        let began = match self.is_stream {
            true => Instant::now(),
            false => self.began,
        };
        let end = began + self.limits.time;
        let activity = self.activity.as_ref();
        self.waiting = activity.map(|it| it.wait(self.messages.unfinished));
        let timer = || Box::pin(sleep_until(end.into()));
        let timer = self.timer.get_or_insert_with(timer);
        timer.as_mut().poll(context).is_ready()
    }
}

impl HttpBody for RequestBody {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
        let this = &mut *self;
        let polled = match &mut this.backlog {
            Some(backlog) => backlog.poll(context, &mut this.inner),
            None => Pin::new(&mut this.inner).poll_frame(context),
        };
        match &polled {
            Poll::Ready(Some(Ok(frame))) => {
                if let Some(Err(status)) = frame.data_ref().map(|bytes| this.receive(bytes)) {
                    return Poll::Ready(Some(Err(status)));
                }
            }
            // A stopping server waits for no client that may never send the rest.
            Poll::Pending if this.is_stopping(context) => {
                return Poll::Ready(Some(Err(refusals::stopping().into())));
            }
            Poll::Pending if this.is_late(context) => {
                this.held.flow().count_slow();
                let status = refusals::too_slow(this.limits.time);
                return Poll::Ready(Some(Err(status.into())));
            }
            // A stream that its client resets has not ended, whatever the reason. Tonic takes CANCELLED for an end.
            Poll::Ready(Some(Err(_)) | None) if this.is_stream && !this.inner.is_end_stream() => {
                return Poll::Ready(Some(Err(Status::unknown("the request was cut"))));
            }
            Poll::Pending | Poll::Ready(_) => {}
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

/// The bytes of a request so far. One buffer would move as it grows, and leave its old places behind: unfinished requests
/// would take more than twice the bytes that they count.
#[derive(Debug, Default)]
struct Arrived {
    /// The last one may have room.
    parts: Vec<Vec<u8>>,
    length: usize,
}

impl Arrived {
    fn push(&mut self, bytes: &[u8]) {
        let room = self.parts.last().map_or(0, |it| it.capacity() - it.len());
        let (fitting, rest) = bytes.split_at(room.min(bytes.len()));
        if let Some(last) = self.parts.last_mut() {
            last.extend_from_slice(fitting);
        }
        if !rest.is_empty() {
            let capacity = rest.len().max(self.length.min(MAX_SPARE_BYTES));
            let mut part = Vec::with_capacity(capacity);
            part.extend_from_slice(rest);
            self.parts.push(part);
        }
        self.length += bytes.len();
    }

    fn join(mut self) -> Bytes {
        if self.parts.len() <= 1 {
            return self.parts.pop().unwrap_or_default().into();
        }
        let mut whole = Vec::with_capacity(self.length);
        for part in self.parts {
            whole.extend_from_slice(&part);
        }
        whole.into()
    }
}

/// The progress within the length-prefixed messages of gRPC.
#[derive(Debug, Default)]
struct Messages {
    /// The messages that are whole.
    ended: u64,
    /// The bytes of the next one so far, its header included.
    unfinished: usize,
    /// Its length without the header, as far as it is known.
    length: usize,
}

impl Messages {
    /// True between two messages.
    fn are_whole(&self) -> bool {
        self.unfinished == 0
    }

    /// The bytes of the newest message so far, its header included.
    fn newest_bytes(&self) -> usize {
        match self.unfinished {
            0 => HEADER_BYTES + self.length,
            unfinished => unfinished,
        }
    }

    fn advance(&mut self, mut bytes: &[u8]) {
        while !bytes.is_empty() {
            if self.unfinished < HEADER_BYTES {
                let byte = usize::from(bytes.get_u8());
                // The first byte is the flag of compression.
                self.length = match self.unfinished {
                    0 => 0,
                    _ => self.length << 8 | byte,
                };
                self.unfinished += 1;
            } else {
                let lacking = HEADER_BYTES + self.length - self.unfinished;
                let skipped = lacking.min(bytes.len());
                bytes.advance(skipped);
                self.unfinished += skipped;
            }
            if self.unfinished >= HEADER_BYTES && self.unfinished == HEADER_BYTES + self.length {
                self.ended += 1;
                self.unfinished = 0;
            }
        }
    }
}

#[cfg(test)]
mod tests;
