//! The requests that HTTP/2 holds because their streams do not read them.
//!
//! HTTP/2 keeps a frame of a request in the buffer that it was read into, with all that its client sent around it: a frame of
//! one byte may hold 16 KiB, and no window of HTTP/2 bounds that. So a connection counts what it has read since its oldest
//! unread frame. A stream that is read and yet is far behind takes its frames out of HTTP/2. A connection for whose count
//! there is no room is not read, and of those with a stream that stands, as its client reads no answers, the one that counts
//! most is cut.

use std::{
    pin::Pin,
    sync::{
        Arc,
        atomic::{AtomicU64, AtomicUsize, Ordering::SeqCst},
    },
    task::{Context, Poll, Wake, Waker},
    time::Duration,
};

use bytes::Bytes;
use futures_util::task::AtomicWaker;
use http_body::{Body, Frame};
use parking_lot::Mutex;
use tokio::time::Instant;

use crate::admission::ByteBudget;

/// The bytes of a stream's frames that HTTP/2 holds at most.
pub(super) const STREAM_WINDOW: u32 = 1024 * 1024;

/// The bytes of a connection after which it counts again.
const STEP: u64 = 64 * 1024;

/// A stream whose oldest frame came this many bytes ago takes its frames out of HTTP/2.
const FAR_BEHIND: u64 = 256 * 1024;

/// The value of [`Unread::since`] while no frame is unread.
const NONE: u64 = u64::MAX;

/// The unread frames of the streams of a connection.
#[derive(Debug)]
pub(super) struct ConnectionBacklog {
    /// The bytes that the connection has read: positions are values of this number.
    position: AtomicU64,
    streams: Mutex<Vec<Arc<Unread>>>,
    budget: Arc<ByteBudget>,
    /// The bytes that are taken from the budget; changed under the lock of the streams.
    counted: AtomicUsize,
}

/// The unread frames of a stream.
#[derive(Debug)]
struct Unread {
    connection: Arc<ConnectionBacklog>,
    /// The position after the part with the oldest of them, or before, or [`NONE`].
    since: AtomicU64,
    /// The bytes of those that are out of HTTP/2.
    taken: AtomicUsize,
    /// The time of the last poll.
    read_at: Mutex<Instant>,
    reader: AtomicWaker,
}

/// The unread frames of a stream, for its reader.
#[derive(Debug)]
pub(super) struct StreamBacklog<E> {
    unread: Arc<Unread>,
    /// Notes the position at which a frame comes, and wakes the reader.
    waker: Waker,
    /// What follows the frames that were taken out.
    next: Option<Option<Result<Frame<Bytes>, E>>>,
}

impl ConnectionBacklog {
    /// That of a connection that has read nothing. All connections share the budget.
    pub(super) fn new(budget: Arc<ByteBudget>) -> Self {
        Self {
            position: AtomicU64::new(0),
            streams: Mutex::default(),
            budget,
            counted: AtomicUsize::new(0),
        }
    }

    /// Notes that the connection has read so many bytes. False if there is no room for those that count now and then.
    #[must_use]
    pub(super) fn note_read(&self, bytes: usize) -> bool {
        let before = self.position.fetch_add(bytes as u64, SeqCst);
        let now = before + bytes as u64;
        before / STEP == now / STEP || self.count()
    }

    /// The bytes that count.
    fn counted(&self) -> usize {
        self.counted.load(SeqCst)
    }

    /// The bytes that count for streams that were not read for `time`.
    pub(super) fn standing(&self, time: Duration) -> u64 {
        let streams = self.streams.lock();
        let stands = |it: &&Arc<Unread>| it.read_at.lock().elapsed() >= time;
        let standing = streams.iter().filter(stands);
        self.behind(standing.map(|it| it.since.load(SeqCst)).min())
    }

    /// The bytes that the connection has read since a position; none if there is no such position.
    fn behind(&self, since: Option<u64>) -> u64 {
        let position = self.position.load(SeqCst);
        position.saturating_sub(since.unwrap_or(NONE))
    }

    /// That of a new stream.
    pub(super) fn open<E>(self: &Arc<Self>) -> StreamBacklog<E> {
        let unread = Arc::new(Unread {
            connection: Arc::clone(self),
            since: AtomicU64::new(self.position.load(SeqCst)),
            taken: AtomicUsize::new(0),
            read_at: Mutex::new(Instant::now()),
            reader: AtomicWaker::new(),
        });
        self.streams.lock().push(Arc::clone(&unread));
        StreamBacklog {
            waker: Arc::clone(&unread).into(),
            unread,
            next: None,
        }
    }

    /// Counts anew. False if there is no room.
    pub(super) fn count(&self) -> bool {
        let streams = self.streams.lock();
        let behind = self.behind(streams.iter().map(|it| it.since.load(SeqCst)).min());
        let taken: usize = streams.iter().map(|it| it.taken.load(SeqCst)).sum();
        let (before, now) = (self.counted(), behind as usize + taken);
        if now <= before {
            self.budget.release(before - now);
        } else if !self.budget.try_take(now - before) {
            return false;
        }
        self.counted.store(now, SeqCst);
        true
    }
}

impl Drop for ConnectionBacklog {
    fn drop(&mut self) {
        self.budget.release(self.counted());
    }
}

impl Wake for Unread {
    fn wake(self: Arc<Self>) {
        self.wake_by_ref();
    }

    fn wake_by_ref(self: &Arc<Self>) {
        let position = self.connection.position.load(SeqCst);
        self.since.fetch_min(position, SeqCst);
        self.reader.wake();
    }
}

impl<E> StreamBacklog<E> {
    /// Polls the next frame of the stream, whose body is `body`; many frames of one that is far behind, as one.
    pub(super) fn poll<B>(
        &mut self,
        context: &mut Context<'_>,
        body: &mut B,
    ) -> Poll<Option<Result<Frame<Bytes>, E>>>
    where
        B: Body<Data = Bytes, Error = E> + Unpin,
    {
        if let Some(next) = self.next.take() {
            return Poll::Ready(next);
        }
        *self.unread.read_at.lock() = Instant::now();
        self.unread.taken.store(0, SeqCst);
        self.unread.reader.register(context.waker());
        let polled = self.poll_body(body);
        let Unread {
            connection, since, ..
        } = &*self.unread;
        let position = connection.position.load(SeqCst);
        let is_far_behind = position.saturating_sub(since.load(SeqCst)) >= FAR_BEHIND;
        let polled = match polled {
            Poll::Ready(Some(Ok(frame))) if is_far_behind => {
                let data = frame
                    .into_data()
                    .map(|first| self.take_all(body, &first, position));
                Poll::Ready(Some(Ok(data.map_or_else(|other| other, Frame::data))))
            }
            polled => polled,
        };
        if polled.is_pending() || is_far_behind {
            // What waits has become less, so there is room.
            let _ = self.unread.connection.count();
        }
        polled
    }

    /// Takes all frames out of HTTP/2 that had come at `position`, and joins them to the first.
    fn take_all<B>(&mut self, body: &mut B, first: &[u8], position: u64) -> Bytes
    where
        B: Body<Data = Bytes, Error = E> + Unpin,
    {
        let mut all = first.to_vec();
        while all.len() < STREAM_WINDOW as usize {
            match self.poll_body(body) {
                Poll::Ready(Some(Ok(frame))) if frame.is_data() => {
                    all.extend_from_slice(&frame.into_data().unwrap_or_default());
                }
                Poll::Ready(next) => {
                    self.next = Some(next);
                    break;
                }
                Poll::Pending => break,
            }
        }
        if all.len() >= STREAM_WINDOW as usize {
            self.unread.since.fetch_max(position, SeqCst);
        }
        self.unread.taken.store(all.len(), SeqCst);
        all.into()
    }

    fn poll_body<B>(&self, body: &mut B) -> Poll<Option<Result<Frame<Bytes>, E>>>
    where
        B: Body<Data = Bytes, Error = E> + Unpin,
    {
        let Unread {
            connection, since, ..
        } = &*self.unread;
        let oldest = since.swap(NONE, SeqCst);
        let oldest = oldest.min(connection.position.load(SeqCst));
        let polled = Pin::new(body).poll_frame(&mut Context::from_waker(&self.waker));
        // Nothing waits behind the end of a stream.
        if matches!(&polled, Poll::Ready(Some(Ok(frame))) if frame.is_data()) {
            since.fetch_min(oldest, SeqCst);
        }
        polled
    }
}

impl<E> Drop for StreamBacklog<E> {
    fn drop(&mut self) {
        let connection = &self.unread.connection;
        let is_other = |it: &Arc<Unread>| !Arc::ptr_eq(it, &self.unread);
        connection.streams.lock().retain(is_other);
        // What counts has become less, so there is room.
        let _ = connection.count();
    }
}
#[cfg(test)]
mod tests {
    use std::collections::VecDeque;

    use proptest::prelude::*;

    use super::*;

    /// What HTTP/2 keeps of a stream.
    #[derive(Default)]
    struct Queue {
        /// Each frame, and the position after it.
        frames: VecDeque<(Bytes, u64)>,
        reader: Option<Waker>,
    }

    impl Body for Queue {
        type Data = Bytes;
        type Error = ();

        fn poll_frame(
            mut self: Pin<&mut Self>,
            context: &mut Context<'_>,
        ) -> Poll<Option<Result<Frame<Bytes>, ()>>> {
            let Some((frame, _)) = self.frames.pop_front() else {
                self.reader = Some(context.waker().clone());
                return Poll::Pending;
            };
            Poll::Ready(Some(Ok(Frame::data(frame))))
        }
    }

    impl Queue {
        fn bytes(&self) -> usize {
            self.frames.iter().map(|(frame, _)| frame.len()).sum()
        }
    }

    /// A stream, its connection, and what was sent and read of the stream.
    struct Run {
        connection: Arc<ConnectionBacklog>,
        stream: StreamBacklog<()>,
        queue: Queue,
        sent: Vec<u8>,
        read: Vec<u8>,
    }

    impl Run {
        fn new(budget: usize) -> Self {
            let budget = Arc::new(ByteBudget::new(budget));
            let connection = Arc::new(ConnectionBacklog::new(budget));
            Self {
                stream: connection.open(),
                connection,
                queue: Queue::default(),
                sent: Vec::new(),
                read: Vec::new(),
            }
        }

        /// The connection reads something else. False if there is no room for what counts.
        fn other(&self, bytes: usize) -> bool {
            self.connection.note_read(bytes)
        }

        /// The connection reads a frame of the stream, if the window has room for it.
        fn frame(&mut self, bytes: usize) -> bool {
            if self.queue.bytes() + bytes > STREAM_WINDOW as usize {
                return true;
            }
            let has_room = self.connection.note_read(bytes);
            let position = self.connection.position.load(SeqCst);
            let frame = vec![self.sent.len() as u8; bytes];
            self.sent.extend_from_slice(&frame);
            self.queue.frames.push_back((frame.into(), position));
            self.queue.reader.take().into_iter().for_each(Waker::wake);
            has_room
        }

        /// Reads the stream once. False if nothing waits.
        fn read(&mut self) -> bool {
            let context = &mut Context::from_waker(Waker::noop());
            match self.stream.poll(context, &mut self.queue) {
                Poll::Ready(frame) => {
                    let data = frame.unwrap().unwrap().into_data().unwrap();
                    self.read.extend_from_slice(&data);
                    true
                }
                Poll::Pending => false,
            }
        }
    }

    #[derive(Clone, Debug)]
    enum Event {
        Frame(usize),
        Other(usize),
        Reads(usize),
    }

    fn bytes() -> impl Strategy<Value = usize> {
        prop_oneof![Just(1), 1..30_000_usize]
    }

    fn event() -> impl Strategy<Value = Event> {
        prop_oneof![
            bytes().prop_map(Event::Frame),
            bytes().prop_map(Event::Other),
            (1..20_usize).prop_map(Event::Reads),
        ]
    }

    proptest! {
        #![proptest_config(crate::testing::cases(200))]

        #[test]
        fn all_that_frames_hold_counts(events in prop::collection::vec(event(), 1..300)) {
            let mut run = Run::new(usize::MAX);
            for event in events {
                match event {
                    Event::Frame(bytes) => prop_assert!(run.frame(bytes)),
                    Event::Other(bytes) => prop_assert!(run.other(bytes)),
                    Event::Reads(times) => for _ in 0..times {
                        if !run.read() {
                            prop_assert_eq!(run.connection.counted(), 0);
                            break;
                        }
                    },
                }
                if let Some((_, oldest)) = run.queue.frames.front() {
                    let held = run.connection.position.load(SeqCst) - oldest;
                    prop_assert!(run.connection.counted() as u64 + STEP > held);
                }
            }
            while run.read() {}
            prop_assert!(run.read == run.sent);
            let Run { connection, stream, .. } = run;
            drop(stream);
            prop_assert_eq!(connection.counted(), 0);
        }

        /// Its client is always ahead: frames come while the stream is read, and HTTP/2 hardly says that none waits.
        #[test]
        fn a_stream_that_is_read_counts_little_whatever_else_its_connection_reads(
            rounds in prop::collection::vec(prop::collection::vec(1..30_000_usize, 2..6), 40..80),
        ) {
            let mut run = Run::new(FAR_BEHIND as usize + 2 * STREAM_WINDOW as usize);
            for frames in rounds {
                prop_assert!(run.other(100_000));
                for bytes in frames {
                    prop_assert!(run.frame(bytes));
                }
                prop_assert!(run.read());
            }
        }
    }

    #[test]
    fn a_stream_that_is_not_read_has_room_for_the_budget() {
        let mut run = Run::new(10 * STEP as usize);
        assert!(run.frame(1));
        assert!(run.other(9 * STEP as usize));
        assert!(!run.other(2 * STEP as usize));
        assert!(run.read() && !run.read());
        assert!(run.other(100 * STEP as usize));
    }
}
