//! The turns in which connections read: the calls that they bring must not pile up in the runtime.

use std::{
    future::Future,
    pin::pin,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering::Relaxed},
    },
    task::{Context, Poll, Wake, Waker},
    time::Duration,
};

use futures_util::task::AtomicWaker;
use tokio::{runtime::Handle, task::yield_now, time::Instant};

use crate::admission::Flow;

/// Bytes after which a connection pauses, if they bring calls: about as many small calls as it may have under way.
const MAX_CALL_BYTES: usize = 4 * 1024;

/// The limit instead while the bytes bring no new call, as in a large request, and after a pause: what has come since the
/// turn before is read at once, so that calls that their client has cancelled meanwhile cost little.
const MAX_TURN_BYTES: usize = 64 * 1024;

/// The tasks in the queue of all threads beyond which no connection begins a further turn. Each call is a task, a cancelled one
/// too, and without this limit clients that cancel their calls let a hundred thousand wait, and health checks for seconds.
const MAX_WAITING_TASKS: usize = 64;

/// The longest pause: large requests arrive under any load. Callers with deadlines gain from a long one, as the connections
/// whose turn it is are served so fast that no call waits in their clients.
const MAX_PAUSE: Duration = Duration::from_secs(1);

/// A connection that reads on after a shorter pause keeps up with its client, whatever that sends.
const SHORT_PAUSE: Duration = Duration::from_millis(1);

/// The turns of one connection.
pub(super) struct ReadTurns {
    /// The bytes that were read in this turn.
    bytes: usize,
    /// The calls of the flow at the begin of the last pause.
    calls: u64,
    /// True if there was nothing to read.
    was_silent: bool,
    /// True in a turn after a pause.
    reads_on: bool,
    pause: Option<Pause>,
}

struct Pause {
    since: Instant,
    others: Arc<Others>,
}

/// Tells when the runtime has looked for other tasks. HTTP/2 asks for bytes again after each call that it hands on, within
/// one poll of its task, so that a pending read alone is no pause.
#[derive(Default)]
struct Others {
    had_turns: AtomicBool,
    waits: AtomicWaker,
}

impl Wake for Others {
    fn wake(self: Arc<Self>) {
        self.had_turns.store(true, Relaxed);
        self.waits.wake();
    }
}

impl Others {
    /// Lets others have their turns.
    fn begin() -> Arc<Self> {
        let others = Arc::new(Self::default());
        let waker = Waker::from(Arc::clone(&others));
        // Its waker is called once the runtime has looked for bytes.
        let _ = pin!(yield_now()).poll(&mut Context::from_waker(&waker));
        others
    }

    fn had_turns(&self, context: &Context<'_>) -> bool {
        self.waits.register(context.waker());
        self.had_turns.load(Relaxed)
    }
}

impl ReadTurns {
    pub(super) fn new() -> Self {
        Self {
            bytes: 0,
            calls: 0,
            was_silent: true,
            reads_on: false,
            pause: None,
        }
    }

    /// Ready if the connection may read.
    pub(super) fn poll(&mut self, flow: &Flow, context: &Context<'_>) -> Poll<()> {
        let calls = flow.calls();
        let has_calls = calls != self.calls;
        let limit = match has_calls && !self.reads_on {
            true => MAX_CALL_BYTES,
            false => MAX_TURN_BYTES,
        };
        if self.bytes >= limit {
            // The arrival of a large request is no delay of the server.
            if !has_calls {
                flow.catch_up();
            }
            self.bytes = 0;
            self.calls = calls;
            self.pause = Some(Pause {
                since: Instant::now(),
                others: Others::begin(),
            });
        }
        if let Some(pause) = &mut self.pause {
            if !pause.others.had_turns(context) {
                return Poll::Pending;
            }
            let paused = pause.since.elapsed();
            let is_busy = is_busy();
            if paused < MAX_PAUSE && is_busy {
                pause.others = Others::begin();
                pause.others.waits.register(context.waker());
                return Poll::Pending;
            }
            if paused < SHORT_PAUSE {
                flow.catch_up();
            }
            self.pause = None;
            self.reads_on = !is_busy;
        }
        Poll::Ready(())
    }

    /// Notes that so many bytes were read; None if there were none to read.
    pub(super) fn note(&mut self, flow: &Flow, bytes: Option<usize>) {
        // Bytes after a silence have just arrived.
        if bytes.is_none() || self.was_silent {
            flow.catch_up();
        }
        self.was_silent = bytes.is_none();
        match bytes {
            Some(bytes) => self.bytes += bytes,
            None => (self.bytes, self.reads_on) = (0, false),
        }
    }
}

/// True while many tasks wait.
fn is_busy() -> bool {
    Handle::current().metrics().global_queue_depth() > MAX_WAITING_TASKS
}

#[cfg(test)]
mod tests;
