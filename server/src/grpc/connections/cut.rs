//! Cuts connections whose clients do not read their answers.

use std::{sync::Arc, time::Duration};

use tokio::time::{Instant, interval};
use tracing::debug;

use super::{Activity, Connections, State};

/// A stream stands that has not read for so long, if its client reads no answers meanwhile.
pub(super) const STANDING_TIME: Duration = Duration::from_secs(1);

/// A stream stands that has not read for so long, whatever its client reads: under overload, a stream waits for seconds.
pub(super) const MAX_STANDING_TIME: Duration = Duration::from_secs(10);

/// The time between two looks at the backlogs of all connections.
pub(super) const LOOK_INTERVAL: Duration = Duration::from_millis(5);

/// The longest time between two looks at the unread answers of all connections.
pub(super) const UNREAD_LOOK_INTERVAL: Duration = Duration::from_secs(1);

impl Connections {
    /// Cuts each connection whose client reads nothing of its answers for `most`. While calls are refused for their bytes, also
    /// the one that holds the most, of those with a part of an answer that has waited for [`MAX_STANDING_TIME`]: a client
    /// could read a little now and then, and leave the rest for ever.
    pub(in crate::grpc) async fn cut_unread(&self, most: Duration) {
        let mut looks = interval(UNREAD_LOOK_INTERVAL.min(most / 4));
        loop {
            looks.tick().await;
            let open = self.open.lock();
            let uncut = open.values().filter(|state| !state.cut.is_cancelled());
            let (standing, others): (Vec<_>, Vec<_>) = uncut.partition(|state| {
                let standstill = state.unread.lock().standstill();
                standstill.is_some_and(|time| time > most)
            });
            let is_late =
                |state: &&Arc<State>| state.unread.lock().longest_wait() >= Some(MAX_STANDING_TIME);
            let largest = match self.admission.is_short_of_bytes() {
                true => others
                    .into_iter()
                    .filter(is_late)
                    .max_by_key(|state| state.flow.held()),
                false => None,
            };
            for state in standing.into_iter().chain(largest) {
                debug!(peer = ?state.peer, "a client that does not read its answers is cut");
                state.cut.cancel();
            }
        }
    }
}

impl Activity {
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
            let standstill = state.unread.lock().standstill();
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
