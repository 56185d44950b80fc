//! The bytes that HTTP/2 holds of a stream whose requests the server does not read, since its client reads no answers.
//!
//! A frame of one byte keeps the buffer that it was read into, with all that its client sent around it, so the windows of
//! HTTP/2 are no bound. What its connection has read since the oldest frame that may wait counts as held by the stream.

use std::{
    pin::Pin,
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering::SeqCst},
    },
    task::{Context, Poll, Wake, Waker},
};

use bytes::Bytes;
use futures_util::task::AtomicWaker;
use http_body::{Body, Frame};
use parking_lot::Mutex;

use crate::admission::HeldBytes;

/// The bytes of a stream that wait at most, without what surrounds their frames.
pub(super) const STREAM_WINDOW: u32 = 1024 * 1024;

/// The bytes of a connection after which those that wait are counted again.
const STEP: u64 = 64 * 1024;

/// The value of [`Waiting::since`] while no frame waits.
const NONE: u64 = u64::MAX;

/// The streams of a connection and the bytes that it has read.
#[derive(Debug, Default)]
pub(super) struct Backlogs {
    read_bytes: AtomicU64,
    streams: Mutex<Vec<Arc<Waiting>>>,
}

/// The frames of a stream that wait to be read.
#[derive(Debug)]
struct Waiting {
    connection: Arc<Backlogs>,
    /// What the connection had read when the oldest of them came, or before, or [`NONE`].
    since: AtomicU64,
    reader: AtomicWaker,
    held: Arc<HeldBytes>,
    /// The bytes that they hold of `held`.
    counted: Mutex<usize>,
}

/// See the module.
#[derive(Debug)]
pub(super) struct Backlog {
    waiting: Arc<Waiting>,
    /// Notes the time at which frames come, and wakes the reader.
    waker: Waker,
    /// What the connection had read at a time since which `taken` bytes of the stream were read.
    checkpoint: u64,
    taken: u64,
}

impl Backlogs {
    /// Counts bytes that the connection has read. False if a stream has no room for what waits.
    #[must_use]
    pub(super) fn note_read(&self, bytes: usize) -> bool {
        let before = self.read_bytes.fetch_add(bytes as u64, SeqCst);
        let now = before + bytes as u64;
        before / STEP == now / STEP || self.streams.lock().iter().all(|it| it.grow(now))
    }

    /// The backlog of a stream, whose bytes are `held`.
    pub(super) fn open(self: &Arc<Self>, held: Arc<HeldBytes>) -> Backlog {
        let now = self.read_bytes.load(SeqCst);
        let waiting = Arc::new(Waiting {
            connection: Arc::clone(self),
            since: AtomicU64::new(now),
            reader: AtomicWaker::new(),
            held,
            counted: Mutex::new(0),
        });
        self.streams.lock().push(Arc::clone(&waiting));
        Backlog {
            waker: Arc::clone(&waiting).into(),
            waiting,
            checkpoint: now,
            taken: 0,
        }
    }
}

impl Waiting {
    /// Counts what waits at `now`. False if there is no room for it.
    fn grow(&self, now: u64) -> bool {
        let mut counted = self.counted.lock();
        let since = self.since.load(SeqCst);
        let bytes = now.saturating_sub(since) as usize;
        if bytes <= *counted {
            return true;
        }
        let has_room = self.held.take(bytes - *counted);
        if has_room {
            *counted = bytes;
        }
        has_room
    }

    /// Gives back what waits no longer.
    fn shrink(&self) {
        let mut counted = self.counted.lock();
        let now = self.connection.read_bytes.load(SeqCst);
        let bytes = now.saturating_sub(self.since.load(SeqCst)) as usize;
        if bytes < *counted {
            self.held.release(*counted - bytes);
            *counted = bytes;
        }
    }
}

impl Wake for Waiting {
    fn wake(self: Arc<Self>) {
        self.wake_by_ref();
    }

    fn wake_by_ref(self: &Arc<Self>) {
        let now = self.connection.read_bytes.load(SeqCst);
        self.since.fetch_min(now, SeqCst);
        self.reader.wake();
    }
}

impl Backlog {
    /// Polls the next frame of the stream, whose body is `body`.
    pub(super) fn poll<B>(
        &mut self,
        context: &mut Context<'_>,
        body: &mut B,
    ) -> Poll<Option<Result<Frame<Bytes>, B::Error>>>
    where
        B: Body<Data = Bytes> + Unpin,
    {
        let waiting = &*self.waiting;
        waiting.reader.register(context.waker());
        let since = waiting.since.swap(NONE, SeqCst);
        let now = waiting.connection.read_bytes.load(SeqCst);
        let polled = Pin::new(body).poll_frame(&mut Context::from_waker(&self.waker));
        match &polled {
            Poll::Pending => (self.checkpoint, self.taken) = (now, 0),
            Poll::Ready(frame) => {
                let frame = frame.as_ref().and_then(|frame| frame.as_ref().ok());
                let data = frame.and_then(Frame::data_ref);
                self.taken += data.map_or(0, Bytes::len) as u64;
                let mut oldest = since.min(now);
                // All that waited at the checkpoint has been read.
                if self.taken >= u64::from(STREAM_WINDOW) {
                    oldest = oldest.max(self.checkpoint);
                    (self.checkpoint, self.taken) = (now, 0);
                }
                waiting.since.fetch_min(oldest, SeqCst);
            }
        }
        waiting.shrink();
        polled
    }
}

impl Drop for Backlog {
    fn drop(&mut self) {
        let is_other = |it: &Arc<Waiting>| !Arc::ptr_eq(it, &self.waiting);
        self.waiting.connection.streams.lock().retain(is_other);
        self.waiting.since.store(NONE, SeqCst);
        self.waiting.shrink();
    }
}

#[cfg(test)]
mod tests {
    use std::{collections::VecDeque, task};

    use proptest::prelude::*;

    use super::*;
    use crate::{admission::Admission, config::Config};

    /// What HTTP/2 keeps of a stream.
    #[derive(Default)]
    struct Queue {
        /// The bytes of each frame, and what the connection had read with it.
        frames: VecDeque<(usize, u64)>,
        reader: Option<Waker>,
    }

    impl Body for Queue {
        type Data = Bytes;
        type Error = ();

        fn poll_frame(
            mut self: Pin<&mut Self>,
            context: &mut Context<'_>,
        ) -> Poll<Option<Result<Frame<Bytes>, ()>>> {
            let Some((bytes, _)) = self.frames.pop_front() else {
                self.reader = Some(context.waker().clone());
                return Poll::Pending;
            };
            Poll::Ready(Some(Ok(Frame::data(vec![0; bytes].into()))))
        }
    }

    impl Queue {
        fn bytes(&self) -> usize {
            self.frames.iter().map(|(bytes, _)| bytes).sum()
        }
    }

    #[derive(Clone, Debug)]
    enum Event {
        /// The connection reads a frame of the stream, if the window has room for it.
        Frame(usize),
        /// The connection reads something else.
        Other(usize),
        /// The stream is read this many times.
        Reads(usize),
    }

    fn event() -> impl Strategy<Value = Event> {
        prop_oneof![
            prop_oneof![Just(1), 1..100_000_usize].prop_map(Event::Frame),
            (1..100_000_usize).prop_map(Event::Other),
            (1..20_usize).prop_map(Event::Reads),
        ]
    }

    fn count(waiting: &Waiting) -> u64 {
        let now = waiting.connection.read_bytes.load(SeqCst);
        now.saturating_sub(waiting.since.load(SeqCst))
    }

    proptest! {
        #![proptest_config(crate::testing::cases(200))]

        #[test]
        fn no_buffer_of_a_frame_that_waits_is_missed(
            events in prop::collection::vec(event(), 1..300),
            has_others in any::<bool>(),
        ) {
            let admission = Admission::new(&Config::default().admission, 1, 0);
            let connection = Arc::new(Backlogs::default());
            let held = Arc::new(admission.open().hold());
            let mut backlog = connection.open(held);
            let waiting = Arc::clone(&backlog.waiting);
            let mut queue = Queue::default();
            let mut context = Context::from_waker(task::Waker::noop());
            prop_assert!(backlog.poll(&mut context, &mut queue).is_pending());
            for event in events {
                match event {
                    Event::Frame(bytes) if queue.bytes() + bytes > STREAM_WINDOW as usize => {}
                    Event::Frame(bytes) => {
                        prop_assert!(connection.note_read(bytes));
                        queue.frames.push_back((bytes, connection.read_bytes.load(SeqCst)));
                        queue.reader.take().into_iter().for_each(Waker::wake);
                    }
                    Event::Other(bytes) if has_others => prop_assert!(connection.note_read(bytes)),
                    Event::Other(_) => {}
                    Event::Reads(times) => for _ in 0..times {
                        if backlog.poll(&mut context, &mut queue).is_pending() {
                            prop_assert_eq!(count(&waiting), 0);
                            prop_assert_eq!(*waiting.counted.lock(), 0);
                            break;
                        }
                    },
                }
                let counted = *waiting.counted.lock() as u64;
                if let Some((_, came)) = queue.frames.front() {
                    prop_assert!(waiting.since.load(SeqCst) <= *came);
                    prop_assert!(counted <= count(&waiting) && count(&waiting) < counted + 2 * STEP);
                }
                if !has_others {
                    prop_assert!(count(&waiting) <= 3 * u64::from(STREAM_WINDOW) + 100_000);
                }
            }
            let held = admission.bytes().0;
            prop_assert_eq!(held, *waiting.counted.lock() as u64);
            drop(backlog);
            prop_assert_eq!(admission.bytes().0, 0);
        }
    }

    #[test]
    fn a_stream_without_room_for_what_waits_is_told() {
        let admission = Admission::new(&Config::default().admission, 1, 0);
        let connection = Arc::new(Backlogs::default());
        let backlog = connection.open(Arc::new(admission.open().hold()));
        let most = admission.bytes().1 as usize;
        assert!(!connection.note_read(most));
        drop(backlog);
        assert!(connection.note_read(most));
    }
}
