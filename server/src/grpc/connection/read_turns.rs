//! The turns of a connection in the [queue](crate::grpc::read_queue) of those that wait to read.

use std::{
    pin::Pin,
    sync::Arc,
    task::{Context, Poll, ready},
    time::Duration,
};

use tokio::{sync::oneshot::Receiver, time::Instant};

use crate::{admission::Flow, grpc::read_queue::ReadQueue};

/// A connection waits for a turn after this many bytes of calls. They hold about 32 small calls, the default of
/// `grpc.max_calls_per_connection`.
const MAX_CALL_BYTES: usize = 4 * 1024;

/// A connection waits for a turn after this many bytes of a large request.
const MAX_REQUEST_BYTES: usize = 64 * 1024;

/// A connection that reads on after a shorter pause keeps up with its client, whatever that sends.
const SHORT_PAUSE: Duration = Duration::from_millis(1);

/// Under load, a connection takes no turns while it sends less than [`MAX_CALL_BYTES`] in this time and all of it is read.
/// Without load it takes none if all is read.
const LIGHT_TIME: Duration = Duration::from_millis(200);

/// The turns of one connection.
pub(super) struct ReadTurns {
    queue: Arc<ReadQueue>,
    /// The time since which the connection is late.
    late_since: Option<Instant>,
    /// The begin of this turn.
    began: Instant,
    /// The bytes of this turn.
    bytes: usize,
    /// The calls of the flow when the last pause began.
    calls: u64,
    /// True if the last read left nothing to read.
    was_silent: bool,
    /// The begin of the wait for the next turn, and that turn.
    pause: Option<(Instant, Receiver<Option<Instant>>)>,
}

impl ReadTurns {
    pub(super) fn new(queue: Arc<ReadQueue>) -> Self {
        Self {
            queue,
            late_since: None,
            began: Instant::now(),
            bytes: 0,
            calls: 0,
            was_silent: true,
            pause: None,
        }
    }

    /// Ready if the connection may read.
    pub(super) fn poll(&mut self, flow: &Flow, context: &mut Context<'_>) -> Poll<()> {
        let calls = flow.calls();
        let has_calls = calls != self.calls;
        let limit = match has_calls {
            true => MAX_CALL_BYTES,
            false => MAX_REQUEST_BYTES,
        };
        if self.bytes >= limit {
            // The arrival of a large request is no delay of the server.
            if !has_calls {
                flow.catch_up();
            }
            (self.bytes, self.calls) = (0, calls);
            let turn = self.queue.enter(flow.is_hurried(), self.late_since);
            self.pause = Some((Instant::now(), turn));
        }
        if let Some((since, turn)) = &mut self.pause {
            // The queue outlives its connections.
            let turn = ready!(Pin::new(turn).poll(context));
            match since.elapsed() < SHORT_PAUSE {
                true => flow.catch_up(),
                // The next bytes may have waited in the socket.
                false => self.was_silent = false,
            }
            self.pause = None;
            self.begin(turn.ok().flatten());
        }
        Poll::Ready(())
    }

    fn begin(&mut self, late_since: Option<Instant>) {
        self.bytes = 0;
        self.late_since = late_since;
        self.began = Instant::now();
    }

    /// Notes a read of `bytes`, and whether nothing is left to read.
    pub(super) fn note(&mut self, flow: &Flow, bytes: usize, is_all: bool) {
        // Bytes after a silence have just arrived.
        if is_all || self.was_silent {
            flow.catch_up();
        }
        self.was_silent = is_all;
        self.bytes += bytes;
        if is_all && (self.began.elapsed() >= LIGHT_TIME || !ReadQueue::is_busy()) {
            self.begin(None);
        }
    }
}

#[cfg(test)]
mod tests;
