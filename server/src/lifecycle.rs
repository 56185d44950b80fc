//! The phases a server goes through, and the one place where they are announced.

use tokio::sync::watch;

/// What a server is doing; phases follow one another in this order and never go back.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Phase {
    /// The listener is open, the stored points are not all there yet: calls are answered UNAVAILABLE.
    Starting,
    /// Calls are answered.
    Serving,
    /// Accepted calls are finished, new ones are refused.
    Stopping,
}

/// Announces the phases.
#[derive(Debug)]
pub(crate) struct Lifecycle(watch::Sender<Phase>);

impl Lifecycle {
    /// A server that has just been started.
    pub(crate) fn starting() -> Self {
        Self(watch::Sender::new(Phase::Starting))
    }

    /// Goes on to `phase`; a phase that lies behind is ignored.
    pub(crate) fn advance(&self, phase: Phase) {
        self.0.send_if_modified(|current| {
            let forward = phase > *current;
            if forward {
                *current = phase;
            }
            forward
        });
    }

    /// A view on the phases for somebody who reacts to them.
    pub(crate) fn watch(&self) -> PhaseWatch {
        PhaseWatch(self.0.subscribe())
    }
}

/// Sees the phases as they are announced. When the `Lifecycle` is gone, the server counts as stopping.
#[derive(Clone, Debug)]
pub(crate) struct PhaseWatch(watch::Receiver<Phase>);

impl PhaseWatch {
    /// The phase now.
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

    /// Ends when the server begins to stop.
    pub(crate) async fn stopping(mut self) {
        // An error means that the sender is gone, and the server with it.
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
