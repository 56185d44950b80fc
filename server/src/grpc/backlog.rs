//! The requests that HTTP/2 holds for streams that have not read them.
//!
//! HTTP/2 keeps a frame of a request in the buffer that it was read into, with all that its client sent around it. A frame of
//! one byte may hold 16 KiB so, and no window of HTTP/2 bounds that. So a connection counts what it has read since the oldest
//! frame that a stream of it has not read.
//!
//! A stream that reads, and still has such an old frame, takes all its frames out of HTTP/2. So what counts for long are
//! streams that stand: the server does not read them, because their client reads no answers. If there is no room for what
//! counts, the connection is not read for a while, and the one that counts most for streams that stand is cut.

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
    /// The position at which the oldest of them had come, or a lower one; [`NONE`] if there is none.
    since: AtomicU64,
    /// The bytes of those that are out of HTTP/2.
    taken: AtomicUsize,
    /// The last time that the stream was asked for a frame.
    read_at: Mutex<Instant>,
    reader: AtomicWaker,
}

/// The unread frames of a stream, for its reader.
#[derive(Debug)]
pub(super) struct StreamBacklog<E> {
    unread: Arc<Unread>,
    /// Notes the position at which a frame comes, and wakes the reader.
    waker: Waker,
    /// The frame, error or end that came behind the frames taken out of HTTP/2. The next poll returns it.
    next: Option<Option<Result<Frame<Bytes>, E>>>,
}

impl ConnectionBacklog {
    /// The backlog of a connection that has read nothing. All connections share the budget.
    pub(super) fn new(budget: Arc<ByteBudget>) -> Self {
        Self {
            position: AtomicU64::new(0),
            streams: Mutex::default(),
            budget,
            counted: AtomicUsize::new(0),
        }
    }

    /// Notes that the connection has read `bytes`, and counts again after each [`STEP`]. Returns false if the budget has
    /// no room for the count.
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

    /// What counts for streams that have not read for `time`.
    pub(super) fn standing(&self, time: Duration) -> u64 {
        let streams = self.streams.lock();
        let stands = |it: &&Arc<Unread>| it.read_at.lock().elapsed() >= time;
        let standing = streams.iter().filter(stands);
        self.behind(standing.map(|it| it.since.load(SeqCst)).min())
    }

    /// The bytes that the connection has read since a position; 0 if that is [`NONE`] or missing.
    fn behind(&self, since: Option<u64>) -> u64 {
        let position = self.position.load(SeqCst);
        position.saturating_sub(since.unwrap_or(NONE))
    }

    /// The backlog of a new stream.
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

    /// Counts the unread bytes again. Returns false if the budget has no room for the count.
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
            // A failure leaves the old count, and the next read of the connection counts again.
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
        // A failure leaves the old count, and the next read of the connection counts again.
        let _ = connection.count();
    }
}

#[cfg(test)]
mod tests;
