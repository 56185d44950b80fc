//! Cuts connections whose clients do not read their answers, or do not send the rest of their requests.

use std::{sync::Arc, time::Duration};

use tokio::time::{Instant, interval};
use tracing::debug;

use super::{Activity, Connections, State, Waits};

/// A stream stands that has not read for so long, if its client reads no answers meanwhile.
pub(super) const STANDING_TIME: Duration = Duration::from_secs(1);

/// A stream stands that has not read for so long, whatever its client reads: under overload, a stream waits for seconds. Bytes
/// that wait for a client for less time are never late.
pub(super) const MAX_STANDING_TIME: Duration = Duration::from_secs(10);

/// The time between two looks at the backlogs of all connections.
pub(super) const LOOK_INTERVAL: Duration = Duration::from_millis(5);

/// The longest time between two looks at what waits for clients.
pub(super) const WAIT_LOOK_INTERVAL: Duration = Duration::from_secs(1);

impl Connections {
    /// Cuts each connection whose client reads nothing of its answers for `most`. While little is left of the bytes of all, it
    /// also cuts the one with the most [late bytes](super::Waits::late_bytes), because a client could read a little now and
    /// then, and leave the rest for ever.
    pub(in crate::grpc) async fn cut_waiting(&self, most: Duration) {
        let mut looks = interval(WAIT_LOOK_INTERVAL.min(most / 4));
        loop {
            looks.tick().await;
            // One with fewer late bytes would free too little.
            let (mut latest, mut most_bytes) = (None, self.admission.little());
            let open = self.open.lock();
            for state in open.values().filter(|it| !it.cut.is_cancelled()) {
                let mut waits = state.waits.lock();
                let held = state.flow.held();
                let late_bytes = waits.late_bytes(held, MAX_STANDING_TIME, most);
                if waits.standstill().is_some_and(|time| time > most) {
                    debug!(peer = ?state.peer, "a client that does not read its answers is cut");
                    state.cut.cancel();
                } else if late_bytes > most_bytes {
                    (latest, most_bytes) = (Some(state), late_bytes);
                }
            }
            if let Some(state) = latest.filter(|_| self.admission.is_short_of_bytes()) {
                debug!(peer = ?state.peer, bytes = most_bytes, "a client that is late is cut: others need its bytes");
                state.cut.cancel();
            }
        }
    }
}

/// An answer whose connection has one of its frames and asks for no other, until this is dropped.
#[derive(Debug)]
pub(in crate::grpc) struct PausedAnswer(Arc<State>);

impl Drop for PausedAnswer {
    fn drop(&mut self) {
        self.0.waits.lock().paused -= 1;
    }
}

impl Waits {
    /// The time for which frames wait and the client reads none.
    fn standstill(&self) -> Option<Duration> {
        (self.frames > 0).then(|| self.frames_since.elapsed())
    }

    /// Looks at the waiting bytes, once in `interval`, and returns those that are late. Bytes are late if they
    /// waited from one look to the next and would take longer than `most` at the client's speed between the two. Bytes that the
    /// client has read or sent since are not late. The calls of the connection hold `held` bytes.
    fn late_bytes(&mut self, held: usize, interval: Duration, most: Duration) -> usize {
        let bytes = match self.paused {
            // Other budgets have the bytes of administration and reflection.
            0 => self.bytes.min(held),
            // The call of a paused answer still holds its request and the data of its next frames.
            _ => held,
        };
        let time = self.looked_at.elapsed();
        if time >= interval {
            let (stood, moved) = (bytes.min(self.bytes_then), self.moved - self.moved_then);
            let needed = stood as f64 * time.as_secs_f64() / most.as_secs_f64();
            self.late_bytes = if (moved as f64) < needed { stood } else { 0 };
            (self.looked_at, self.bytes_then, self.moved_then) =
                (Instant::now(), bytes, self.moved);
        }
        let moved = self.moved - self.moved_then;
        self.late_bytes.saturating_sub(moved as usize).min(bytes)
    }
}

impl Activity {
    /// Notes that the connection has a frame of an answer, until the result is dropped.
    pub(in crate::grpc) fn pause_answer(&self) -> PausedAnswer {
        self.state.waits.lock().paused += 1;
        PausedAnswer(Arc::clone(&self.state))
    }

    /// Cuts the connection whose streams that stand have the most unread requests, perhaps this one, unless it is on its
    /// way out: the budget of all is spent.
    pub(in crate::grpc) fn cut_longest_backlog(&self) {
        let mut looked_at = self.connections.looked_at.lock();
        if looked_at.is_some_and(|at| at.elapsed() < LOOK_INTERVAL) {
            return;
        }
        *looked_at = Some(Instant::now());
        let open = self.connections.open.lock();
        let standing = open.values().map(|state| {
            let standstill = state.waits.lock().standstill();
            let time = match standstill.is_some_and(|time| time >= STANDING_TIME) {
                true => STANDING_TIME,
                false => MAX_STANDING_TIME,
            };
            (state.backlog.standing(time), state)
        });
        let longest = standing.max_by_key(|(bytes, _)| *bytes);
        if let Some((1.., state)) = longest.filter(|(_, state)| !state.cut.is_cancelled()) {
            self.connections.admission.of_backlogs().refuse();
            debug!(peer = ?state.peer, "a client that sends on streams and does not read their answers is cut");
            state.cut.cancel();
        }
    }
}
