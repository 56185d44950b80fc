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
    /// True if the request is a stream: it holds the bytes of the message on its way in only.
    is_stream: bool,
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
            true => {
                self.held.release(before.0);
                self.held.take(self.messages.unfinished)
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
    use futures_util::{StreamExt, stream};
    use http_body_util::StreamBody;
    use proptest::prelude::*;
    use tokio::time::timeout;

    use super::*;
    use crate::{admission::Admission, config::Config};

    fn request(frames: Vec<Bytes>, is_stream: bool) -> RequestBody {
        let frames = frames
            .into_iter()
            .map(|bytes| Ok::<_, Status>(Frame::data(bytes)));
        let inner = Body::new(StreamBody::new(stream::iter(frames)));
        let limits = RequestLimits {
            message: MessageLimit::of_setting(1000),
            time: Duration::from_secs(60),
            may_pause: false,
        };
        let admission = Admission::new(&Config::default().admission, 1, 0);
        let (held, now) = (Arc::new(admission.open().hold()), Instant::now());
        let service = Service::starting(Default::default());
        RequestBody::new(inner, limits, held, None, is_stream, now, service)
    }

    async fn whole_of(frames: Vec<Bytes>) -> Result<Bytes, Status> {
        request(frames, false).whole().await
    }

    #[tokio::test(start_paused = true)]
    async fn a_stream_that_may_not_pause_ends_after_its_time() {
        let message = Bytes::from_static(&[0, 0, 0, 0, 0]);
        for may_pause in [false, true] {
            let mut stream = request(vec![message.clone()], true);
            let sent = stream::iter([Ok::<_, Status>(Frame::data(message.clone()))]);
            stream.inner = Body::new(StreamBody::new(sent.chain(stream::pending())));
            stream.limits.may_pause = may_pause;
            assert!(stream.frame().await.unwrap().is_ok());
            let next = timeout(2 * stream.limits.time, stream.frame()).await;
            assert_eq!(next.is_err(), may_pause);
            if let Ok(ended) = next {
                let code = ended.unwrap().unwrap_err().code();
                assert_eq!(code, tonic::Code::ResourceExhausted);
            }
        }
    }

    /// Hyper reports no error for some resets: the body is over, and not at its end.
    #[tokio::test]
    async fn a_stream_that_is_reset_has_not_ended() {
        let mut stream = request(vec![Bytes::from_static(&[0, 0, 0, 0, 0])], true);
        assert!(stream.frame().await.unwrap().is_ok());
        assert!(stream.frame().await.unwrap().is_err());
    }

    /// Frames of one byte would hold more than thirty times what they count.
    #[tokio::test]
    async fn a_whole_request_holds_none_of_its_frames() {
        let mut sent = BytesMut::new();
        sent.put_slice(&[0, 0, 0, 0, 100]);
        sent.put_bytes(7, 100);
        let sent = sent.freeze();
        let frames = (0..sent.len()).map(|at| sent.slice(at..at + 1));
        let whole = whole_of(frames.collect()).await.unwrap();
        assert_eq!(whole, sent);
        assert!(sent.is_unique());
    }

    #[tokio::test]
    async fn a_second_message_is_refused() {
        let message = Bytes::from_static(&[0, 0, 0, 0, 1, 7]);
        whole_of(vec![message.clone()]).await.unwrap();
        for rest in [message.clone(), message.slice(..1)] {
            let refused = whole_of(vec![message.clone(), rest]).await.unwrap_err();
            assert_eq!(refused.code(), tonic::Code::InvalidArgument);
        }
    }

    proptest! {
        #![proptest_config(crate::testing::cases(200))]

        #[test]
        fn what_has_arrived_is_kept_in_order_and_with_few_spare_bytes(
            frames in prop::collection::vec(prop::collection::vec(any::<u8>(), 0..3_000), 1..200),
        ) {
            let mut arrived = Arrived::default();
            for (at, frame) in frames.iter().enumerate() {
                arrived.push(frame);
                let length: usize = frames[..=at].iter().map(Vec::len).sum();
                let kept: usize = arrived.parts.iter().map(Vec::capacity).sum();
                prop_assert!(kept <= length + length.min(MAX_SPARE_BYTES), "{} of {}", kept, length);
            }
            prop_assert_eq!(arrived.join(), frames.concat());
        }

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
