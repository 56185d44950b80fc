//! The phases of a server's life, announced in one place.

use tokio::sync::watch;

/// A phase of a server's life. Phases only advance, in this order.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Phase {
    /// The listener is open and the log is being replayed: calls get `UNAVAILABLE`.
    Starting,
    /// Calls are answered.
    Serving,
    /// Accepted calls finish; new ones are refused.
    Stopping,
}

/// Announces the phases.
#[derive(Debug)]
pub(crate) struct Lifecycle(watch::Sender<Phase>);

impl Lifecycle {
    /// The lifecycle of a server that starts.
    pub(crate) fn starting() -> Self {
        Self(watch::Sender::new(Phase::Starting))
    }

    /// Advances to `phase`. An earlier phase than the current one is ignored.
    pub(crate) fn advance(&self, phase: Phase) {
        self.0.send_if_modified(|current| {
            let forward = phase > *current;
            if forward {
                *current = phase;
            }
            forward
        });
    }

    /// A receiver of the phases from now on.
    pub(crate) fn watch(&self) -> PhaseWatch {
        PhaseWatch(self.0.subscribe())
    }
}

/// Receives the phases. Once the `Lifecycle` is dropped, the phase is `Stopping`.
#[derive(Clone, Debug)]
pub(crate) struct PhaseWatch(watch::Receiver<Phase>);

impl PhaseWatch {
    /// The current phase.
    pub(crate) fn current(&self) -> Phase {
        *self.0.borrow()
    }

    /// Waits for a phase other than `known` and returns it.
    pub(crate) async fn changed_from(&mut self, known: Phase) -> Phase {
        match self.0.wait_for(|phase| *phase != known).await {
            Ok(phase) => *phase,
            Err(_) => Phase::Stopping,
        }
    }

    /// Resolves when the server begins to stop.
    pub(crate) async fn stopping(mut self) {
        // An error means that the sender was dropped, and the server with it.
        let _ = self.0.wait_for(|phase| *phase == Phase::Stopping).await;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn phases_go_forward_only() {
        let lifecycle = Lifecycle::starting();
        let mut watch = lifecycle.watch();
        assert_eq!(watch.current(), Phase::Starting);
        lifecycle.advance(Phase::Stopping);
        lifecycle.advance(Phase::Serving);
        assert_eq!(watch.changed_from(Phase::Starting).await, Phase::Stopping);
        watch.stopping().await;
    }

    #[tokio::test]
    async fn a_lost_lifecycle_is_a_stopped_server() {
        let watch = Lifecycle::starting().watch();
        watch.clone().stopping().await;
        assert_eq!(
            watch.clone().changed_from(Phase::Starting).await,
            Phase::Stopping
        );
    }
}
