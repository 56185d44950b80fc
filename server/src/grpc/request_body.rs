//! The body of a request on its way in: its bytes are counted, and its time is limited.
//!
//! A client that sends parts of messages holds memory of the server for as long as it likes. So all requests together
//! may hold a number of bytes, those of one connection a share of it, and a request must arrive in time.

use std::{
    pin::Pin,
    sync::{
        Arc,
        atomic::{AtomicUsize, Ordering::Relaxed},
    },
    task::{Context, Poll},
    time::{Duration, Instant},
};

use bytes::{Buf, Bytes};
use http_body::{Body as HttpBody, Frame, SizeHint};
use tokio::time::Sleep;
use tonic::{Status, body::Body};

use super::{connections::Activity, refusals};
use crate::admission::ByteBudget;

/// Bytes before each message: a flag and the length.
pub(super) const HEADER_BYTES: usize = 5;

/// The most that requests may hold, and the time in which each must arrive.
#[derive(Clone, Debug)]
pub(super) struct RequestLimits {
    /// The bytes of all requests.
    pub(super) all: Arc<ByteBudget>,
    /// The time of a request, and of each message of a stream.
    pub(super) time: Duration,
}

/// The bytes that the request of one call holds, until it is dropped.
#[derive(Debug)]
pub(super) struct HeldBytes {
    all: Arc<ByteBudget>,
    activity: Option<Activity>,
    held: AtomicUsize,
}

impl HeldBytes {
    fn new(all: Arc<ByteBudget>, activity: Option<Activity>) -> Self {
        let held = AtomicUsize::new(0);
        Self {
            all,
            activity,
            held,
        }
    }

    /// Holds more bytes; false if they exceed a budget.
    fn take(&self, bytes: usize) -> bool {
        if !self.all.take(bytes) {
            return false;
        }
        let own = self.activity.as_ref().map(Activity::request_bytes);
        if own.is_some_and(|own| !own.take(bytes)) {
            self.all.give_back(bytes);
            return false;
        }
        self.held.fetch_add(bytes, Relaxed);
        true
    }

    /// Holds these bytes in place of those so far; false if they exceed a budget.
    fn hold(&self, bytes: usize) -> bool {
        let held = self.held.load(Relaxed);
        if bytes > held {
            return self.take(bytes - held);
        }
        self.held.store(bytes, Relaxed);
        self.all.give_back(held - bytes);
        if let Some(activity) = &self.activity {
            activity.request_bytes().give_back(held - bytes);
        }
        true
    }
}

impl Drop for HeldBytes {
    fn drop(&mut self) {
        self.hold(0);
    }
}

/// See the module.
pub(super) struct RequestBody {
    inner: Body,
    limits: RequestLimits,
    held: Arc<HeldBytes>,
    /// True if the request is a stream: it holds the bytes of the message on its way in only.
    is_stream: bool,
    messages: Messages,
    began: Instant,
    /// Set at the first wait for a message.
    timer: Option<Pin<Box<Sleep>>>,
}

impl RequestBody {
    /// The body of a call that began at `began`, and the bytes that it holds.
    pub(super) fn wrap(
        inner: Body,
        limits: &RequestLimits,
        activity: Option<Activity>,
        is_stream: bool,
        began: Instant,
    ) -> (Body, Arc<HeldBytes>) {
        let held = Arc::new(HeldBytes::new(Arc::clone(&limits.all), activity));
        let body = Body::new(Self {
            inner,
            limits: limits.clone(),
            held: Arc::clone(&held),
            is_stream,
            messages: Messages::default(),
            began,
            timer: None,
        });
        (body, held)
    }

    fn receive(&mut self, bytes: &Bytes) -> Result<(), Status> {
        let (was_between, ended) = (self.messages.are_whole(), self.messages.ended);
        self.messages.advance(bytes);
        if was_between || self.messages.ended > ended {
            self.timer = None;
        }
        let is_held = match self.is_stream {
            true => self.held.hold(self.messages.unfinished),
            false => self.held.take(bytes.len()),
        };
        match is_held {
            true => Ok(()),
            false => Err(refusals::too_many_bytes(self.limits.all.max()).into()),
        }
    }

    fn is_late(&mut self, context: &mut Context<'_>) -> bool {
        if self.is_stream && self.messages.are_whole() {
            return false;
        }
        // The time for which a stream was not read does not count.
        let began = if self.is_stream {
            Instant::now()
        } else {
            self.began
        };
        let end = began + self.limits.time;
        let timer = self
            .timer
            .get_or_insert_with(|| Box::pin(tokio::time::sleep_until(end.into())));
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
        let polled = Pin::new(&mut this.inner).poll_frame(context);
        match &polled {
            Poll::Ready(Some(Ok(frame))) => {
                if let Some(Err(status)) = frame.data_ref().map(|bytes| this.receive(bytes)) {
                    return Poll::Ready(Some(Err(status)));
                }
            }
            Poll::Pending if this.is_late(context) => {
                let status = refusals::too_slow(this.limits.time);
                return Poll::Ready(Some(Err(status.into())));
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
mod tests {
    use bytes::{BufMut, BytesMut};
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #![proptest_config(crate::testing::cases(200))]

        #[test]
        fn messages_are_whole_at_their_ends_only(
            lengths in prop::collection::vec(0..40_usize, 1..8),
            pieces in prop::collection::vec(1..12_usize, 1..100),
        ) {
            let (mut sent, mut ends) = (BytesMut::new(), vec![0]);
            for length in lengths {
                sent.put_u8(0);
                sent.put_u32(length as u32);
                sent.put_bytes(255, length);
                ends.push(sent.len());
            }
            let (mut messages, mut at) = (Messages::default(), 0);
            for piece in pieces.into_iter().cycle() {
                let begun = ends.iter().rposition(|end| *end <= at).unwrap();
                prop_assert_eq!(messages.ended, begun as u64);
                prop_assert_eq!(messages.unfinished, at - ends[begun]);
                prop_assert_eq!(messages.are_whole(), ends.contains(&at));
                if at == sent.len() {
                    break;
                }
                let end = sent.len().min(at + piece);
                messages.advance(&sent[at..end]);
                at = end;
            }
        }
    }
}
