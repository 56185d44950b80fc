//! Cuts connections whose clients do not read.

use std::{sync::atomic::Ordering::SeqCst, time::Duration};

use tokio::time::interval;
use tracing::debug;

use super::{Connections, State};

/// A stopping server waits for this long for a client that reads nothing of its streams.
const MAX_WAIT_AT_STOP: Duration = Duration::from_secs(2);

impl Connections {
    /// Cuts each connection whose client reads nothing of its answers for `most`.
    pub(in crate::grpc) async fn cut_unread(&self, most: Duration) {
        self.cut_where(most / 4, |state| state.is_unread_for(most))
            .await;
    }

    /// Cuts each connection whose calls are streams that last and only wait for their client to read, as a server does that
    /// stops.
    pub(in crate::grpc) async fn cut_waiting(&self) {
        let waits = |state: &State| {
            let streams = self.max_streams - state.streams.available_permits();
            let calls = state.calls.load(SeqCst);
            calls > 0
                && calls <= streams
                && state.silence() > MAX_WAIT_AT_STOP
                && state.is_unread_for(MAX_WAIT_AT_STOP)
        };
        self.cut_where(MAX_WAIT_AT_STOP / 8, waits).await;
    }

    async fn cut_where(&self, interval_of_checks: Duration, is_cut: impl Fn(&State) -> bool) {
        let mut checks = interval(interval_of_checks);
        loop {
            checks.tick().await;
            for state in self.open.lock().values().filter(|state| is_cut(state)) {
                debug!(peer = ?state.peer, "a client that does not read its answers is cut");
                state.cut.cancel();
            }
        }
    }
}

impl State {
    /// True if its client has read nothing of its answers for longer than `most`.
    fn is_unread_for(&self, most: Duration) -> bool {
        let unread = self.unread.lock();
        unread.frames > 0 && unread.since.elapsed() > most
    }
}
