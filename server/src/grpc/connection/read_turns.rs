//! Each connection reads in turns, so that its calls do not pile up in the runtime.

use std::{
    future::Future,
    pin::pin,
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicUsize, Ordering::Relaxed},
    },
    task::{Context, Poll, Wake, Waker},
    time::Duration,
};

use futures_util::task::AtomicWaker;
use tokio::{runtime::Handle, task::yield_now, time::Instant};

use crate::admission::Flow;

/// A connection pauses after this many bytes of calls. They hold about 32 small calls, the default of
/// `grpc.max_calls_per_connection`.
const MAX_CALL_BYTES: usize = 4 * 1024;

/// A connection pauses after this many bytes of a large request, and in a long turn. A long turn reads the resets of
/// cancelled calls together with these calls.
const MAX_TURN_BYTES: usize = 64 * 1024;

/// A pause continues while more tasks than this wait in the global queue of the runtime. Each call is a task, a cancelled
/// one too. Without this limit up to 89,000 tasks waited, and health checks took seconds.
const MAX_WAITING_TASKS: usize = 16;

/// The longest pause. After it a connection reads one short turn under any load, so a large request still arrives at
/// about 80 KiB a second. Shorter pauses answer fewer calls with deadlines in time. The pause is shorter than the default
/// of `admission.burst_ms`, because admission refuses a long call that waited unread for that time.
const MAX_PAUSE: Duration = Duration::from_millis(800);

/// A connection that reads on after a shorter pause keeps up with its client, whatever that sends.
const SHORT_PAUSE: Duration = Duration::from_millis(1);

/// The turns of one connection.
pub(super) struct ReadTurns {
    /// The bytes of this turn.
    bytes: usize,
    /// The calls of the flow when the last pause began.
    calls: u64,
    /// True if the last read left nothing to read.
    was_silent: bool,
    /// True if the last pause ended because few tasks waited: this turn is long.
    is_long: bool,
    pause: Option<Pause>,
    /// The pauses of all connections.
    pauses: Pauses,
}

/// The number of paused connections. Their tasks are in the queue too, and must not wait for each other.
#[derive(Clone, Debug, Default)]
pub(super) struct Pauses(Arc<AtomicUsize>);

struct Pause {
    since: Instant,
    others: Arc<Others>,
    all: Pauses,
}

impl Pause {
    fn begin(all: &Pauses) -> Self {
        all.0.fetch_add(1, Relaxed);
        Self {
            since: Instant::now(),
            others: Others::begin(),
            all: all.clone(),
        }
    }
}

impl Drop for Pause {
    fn drop(&mut self) {
        self.all.0.fetch_sub(1, Relaxed);
    }
}

impl Pauses {
    /// True while many other tasks wait.
    fn is_busy(&self) -> bool {
        let waiting = Handle::current().metrics().global_queue_depth();
        waiting > MAX_WAITING_TASKS + self.0.load(Relaxed)
    }
}

/// A flag that the runtime sets once other tasks had their turns. HTTP/2 polls the connection again after each call that
/// it hands on, within one poll of its task, so a pending read alone is no pause. The task's own waker does not tell who
/// called it.
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
    /// Asks the runtime to run other tasks.
    fn begin() -> Arc<Self> {
        let others = Arc::new(Self::default());
        let waker = Waker::from(Arc::clone(&others));
        // The runtime calls this waker after it has polled for I/O.
        let _ = pin!(yield_now()).poll(&mut Context::from_waker(&waker));
        others
    }

    fn had_turns(&self, context: &Context<'_>) -> bool {
        self.waits.register(context.waker());
        self.had_turns.load(Relaxed)
    }
}

impl ReadTurns {
    pub(super) fn new(pauses: Pauses) -> Self {
        Self {
            bytes: 0,
            calls: 0,
            was_silent: true,
            is_long: false,
            pause: None,
            pauses,
        }
    }

    /// Ready if the connection may read.
    pub(super) fn poll(&mut self, flow: &Flow, context: &Context<'_>) -> Poll<()> {
        let calls = flow.calls();
        let has_calls = calls != self.calls;
        let limit = match has_calls && !self.is_long {
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
            self.pause = Some(Pause::begin(&self.pauses));
        }
        if let Some(pause) = &mut self.pause {
            if !pause.others.had_turns(context) {
                return Poll::Pending;
            }
            let (paused, is_busy) = (pause.since.elapsed(), self.pauses.is_busy());
            if is_busy && paused < MAX_PAUSE {
                pause.others = Others::begin();
                if pause.others.had_turns(context) {
                    context.waker().wake_by_ref();
                }
                return Poll::Pending;
            }
            if paused < SHORT_PAUSE {
                flow.catch_up();
            }
            self.pause = None;
            self.is_long = !is_busy;
        }
        Poll::Ready(())
    }

    /// Notes a read of `bytes`, and whether nothing is left to read.
    pub(super) fn note(&mut self, flow: &Flow, bytes: usize, is_all: bool) {
        // Bytes after a silence have just arrived.
        if is_all || self.was_silent {
            flow.catch_up();
        }
        self.was_silent = is_all;
        self.bytes += bytes;
        if is_all {
            (self.bytes, self.is_long) = (0, false);
        }
    }
}

#[cfg(test)]
mod tests;
