//! Why a store is written no longer: the first failure of any of its threads, of which the log tells once.

use parking_lot::Mutex;
use tracing::error;

use crate::log::LogError;

/// See the module.
#[derive(Default)]
pub(super) struct Failure(Mutex<Option<LogError>>);

impl Failure {
    /// What it is, if there is one.
    pub(super) fn get(&self) -> Option<LogError> {
        self.0.lock().clone()
    }

    /// Takes note of an error, after which, if it is one of the store and the first, nothing is written any more.
    pub(super) fn note(&self, error: &LogError) {
        if !matches!(error, LogError::Storage { .. }) {
            return;
        }
        let mut first = self.0.lock();
        if first.is_none() {
            error!(%error, "the log has failed");
            *first = Some(error.clone());
        }
    }
}
