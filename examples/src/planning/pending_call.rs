//! A call that runs in the background of a worker.

use tokio::task::JoinHandle;

use super::error::PlanningError;

/// A call that may be under way.
pub struct PendingCall<T>(Option<JoinHandle<Result<T, PlanningError>>>);

impl<T> Default for PendingCall<T> {
    fn default() -> PendingCall<T> {
        PendingCall(None)
    }
}

impl<T: Send + 'static> PendingCall<T> {
    /// Begins one, on the runtime's threads.
    pub fn begin(&mut self, call: impl Future<Output = Result<T, PlanningError>> + Send + 'static) {
        self.0 = Some(tokio::spawn(call));
    }

    /// Waits for its end, if there is one.
    pub async fn finish(&mut self) -> Result<Option<T>, PlanningError> {
        let Some(call) = self.0.take() else {
            return Ok(None);
        };
        // The join fails only if the call panicked, or if the runtime ends, and then nothing waits.
        call.await.expect("a call does not panic").map(Some)
    }
}
