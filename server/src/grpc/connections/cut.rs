//! Cuts connections whose clients do not read.

use std::time::Duration;

use tokio::time::interval;
use tracing::debug;

use super::Connections;

impl Connections {
    /// Cuts each connection whose client reads nothing of its answers for `most`.
    pub(in crate::grpc) async fn cut_unread(&self, most: Duration) {
        let mut checks = interval(most / 4);
        loop {
            checks.tick().await;
            for state in self.open.lock().values() {
                let unread = state.unread.lock();
                if unread.frames > 0 && unread.since.elapsed() > most {
                    debug!(peer = ?state.peer, "a client that does not read its answers is cut");
                    state.cut.cancel();
                }
            }
        }
    }
}
