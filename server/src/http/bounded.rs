//! The connections to the pages for operators, which are few. One ends after a time in which it took nothing. Once all slots
//! are taken, one without a call makes room for the next: strangers keep no probe out, and end no stream.

use std::{
    collections::BTreeMap,
    io,
    pin::Pin,
    sync::Arc,
    task::{Context, Poll},
    time::Duration,
};

use parking_lot::Mutex;
use tokio::{
    io::{AsyncRead, AsyncWrite, ReadBuf},
    sync::{OwnedSemaphorePermit, Semaphore},
    time::{Instant, Sleep, sleep_until, timeout},
};
use tokio_util::{
    sync::{CancellationToken, WaitForCancellationFutureOwned},
    task::TaskTracker,
};

use crate::grpc::Socket;

/// The time in which a connection takes some bytes of an answer. Clients of HTTP connect again by themselves.
const MAX_STALL: Duration = Duration::from_secs(60);

/// A connection keeps its slot for this long after it was opened and after it took bytes: its request may be on its way.
/// Probes wait a second for an answer.
const MIN_SILENCE: Duration = Duration::from_millis(250);

/// The bytes that a connection without an admitted call sends before it gets an answer: the heads of requests, which nothing
/// else counts.
const MAX_HEAD_BYTES: usize = 64 << 10;

/// The slots of a listener.
pub(super) struct ConnectionSlots {
    free: Arc<Semaphore>,
    /// The connections by the order in which they were opened.
    open: Mutex<BTreeMap<u64, OpenConnection>>,
}

struct OpenConnection {
    opened_at: Instant,
    active_at: Instant,
    /// The admitted calls.
    calls: TaskTracker,
    cut: CancellationToken,
}

/// A slot, until it is dropped.
pub(super) struct ConnectionSlot {
    slots: Arc<ConnectionSlots>,
    number: u64,
    cut: CancellationToken,
    /// The admitted calls of its connection take tokens of it.
    pub(super) calls: TaskTracker,
    _permit: OwnedSemaphorePermit,
}

impl ConnectionSlots {
    pub(super) fn new(limit: usize) -> Arc<Self> {
        Arc::new(Self {
            free: Arc::new(Semaphore::new(limit)),
            open: Mutex::default(),
        })
    }

    /// Waits for a slot, which another connection gives up if there is no other.
    pub(super) async fn take(self: &Arc<Self>) -> ConnectionSlot {
        let permit = loop {
            if let Ok(permit) = Arc::clone(&self.free).try_acquire_owned() {
                break permit;
            }
            self.give_one_up();
            let free = Arc::clone(&self.free).acquire_owned();
            if let Ok(Ok(permit)) = timeout(MIN_SILENCE, free).await {
                break permit;
            }
        };
        let cut = CancellationToken::new();
        let calls = TaskTracker::new();
        let mut open = self.open.lock();
        let number = open.last_key_value().map_or(0, |(last, _)| last + 1);
        let connection = OpenConnection {
            opened_at: Instant::now(),
            active_at: Instant::now(),
            calls: calls.clone(),
            cut: cut.clone(),
        };
        open.insert(number, connection);
        drop(open);
        ConnectionSlot {
            slots: Arc::clone(self),
            number,
            cut,
            calls,
            _permit: permit,
        }
    }

    /// Cuts the connection without a call that was silent for the longest time, or the first one if none is silent; if all
    /// have calls, the one that was silent for the longest time.
    fn give_one_up(&self) {
        let open = self.open.lock();
        // A connection that is cut may take a while to end, and is not cut again.
        let open = || open.values().filter(|it| !it.cut.is_cancelled());
        let without_call = || open().filter(|it| it.calls.is_empty());
        let is_silent = |it: &&OpenConnection| it.active_at.elapsed() >= MIN_SILENCE;
        let least = without_call()
            .min_by_key(|it| it.active_at)
            .filter(is_silent);
        // A stranger that asks for one probe after another is never silent.
        let first = || without_call().find(|it| it.opened_at.elapsed() >= MIN_SILENCE);
        let with_call = || open().min_by_key(|it| it.active_at).filter(is_silent);
        if let Some(connection) = least.or_else(first).or_else(with_call) {
            connection.cut.cancel();
        }
    }
}

impl ConnectionSlot {
    fn note_activity(&self) {
        if let Some(connection) = self.slots.open.lock().get_mut(&self.number) {
            connection.active_at = Instant::now();
        }
    }
}

impl Drop for ConnectionSlot {
    fn drop(&mut self) {
        self.slots.open.lock().remove(&self.number);
    }
}

/// A connection with its slot.
pub(super) struct BoundedConnection {
    socket: Socket,
    end: Pin<Box<Sleep>>,
    cut: Pin<Box<WaitForCancellationFutureOwned>>,
    slot: ConnectionSlot,
    /// The bytes that came since the last answer, of no admitted call.
    head_bytes: usize,
}

impl BoundedConnection {
    pub(super) fn new(socket: Socket, slot: ConnectionSlot) -> Self {
        Self {
            socket,
            end: Box::pin(sleep_until(Instant::now() + MAX_STALL)),
            cut: Box::pin(slot.cut.clone().cancelled_owned()),
            slot,
            head_bytes: 0,
        }
    }

    /// Fails once the connection is cut or its time is over. Every poll begins with it: over TLS, bytes may wait in the
    /// buffer of the socket, and then the server only flushes or shuts down.
    fn check(&mut self, context: &mut Context<'_>) -> io::Result<()> {
        if self.cut.as_mut().poll(context).is_ready() {
            return Err(io::ErrorKind::ConnectionAborted.into());
        }
        match self.end.as_mut().poll(context) {
            Poll::Ready(()) => Err(io::ErrorKind::TimedOut.into()),
            Poll::Pending => Ok(()),
        }
    }

    /// Writes, and notes whether the client took bytes.
    fn write_some(
        &mut self,
        context: &mut Context<'_>,
        write: impl FnOnce(Pin<&mut Socket>, &mut Context<'_>) -> Poll<io::Result<usize>>,
    ) -> Poll<io::Result<usize>> {
        self.check(context)?;
        let written = write(Pin::new(&mut self.socket), context);
        if matches!(written, Poll::Ready(Ok(1..))) {
            self.end.as_mut().reset(Instant::now() + MAX_STALL);
            self.head_bytes = 0;
            self.slot.note_activity();
        }
        written
    }
}

impl AsyncRead for BoundedConnection {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        self.check(context)?;
        let before = buffer.filled().len();
        let read = Pin::new(&mut self.socket).poll_read(context, buffer);
        if self.slot.calls.is_empty() {
            self.head_bytes += buffer.filled().len() - before;
            if self.head_bytes > MAX_HEAD_BYTES {
                return Poll::Ready(Err(io::ErrorKind::ConnectionAborted.into()));
            }
        }
        read
    }
}

impl AsyncWrite for BoundedConnection {
    fn poll_write(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        self.write_some(context, |socket, context| socket.poll_write(context, bytes))
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        slices: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        self.write_some(context, |socket, context| {
            socket.poll_write_vectored(context, slices)
        })
    }

    /// Without it, hyper would copy answers into a buffer that nothing counts.
    fn is_write_vectored(&self) -> bool {
        self.socket.is_write_vectored()
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        self.check(context)?;
        Pin::new(&mut self.socket).poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        self.check(context)?;
        Pin::new(&mut self.socket).poll_shutdown(context)
    }
}

#[cfg(test)]
mod tests;
