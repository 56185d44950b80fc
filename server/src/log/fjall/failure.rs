//! The first failure of a store, after which nothing is written. It is logged once.
//!
//! After a failure of one of its own threads, fjall reports no cause. The error of the disk, or a damaged block that a
//! full read finds, is then reported instead.

use tokio::sync::watch;
use tracing::error;

use crate::log::LogError;

/// The first failure of a store, observable by its watchers.
pub(super) struct Failure(watch::Sender<Option<LogError>>);

impl Default for Failure {
    fn default() -> Self {
        Self(watch::Sender::new(None))
    }
}

impl Failure {
    pub(super) fn get(&self) -> Option<LogError> {
        self.0.borrow().clone()
    }

    pub(super) fn watch(&self) -> watch::Receiver<Option<LogError>> {
        self.0.subscribe()
    }

    /// Notes an error; after the first error of the store, nothing is written. Returns the error to report. For an error
    /// of the store that is the first one, because later ones follow from it.
    pub(super) fn note(&self, error: LogError) -> LogError {
        if !matches!(
            error,
            LogError::Storage { .. } | LogError::StorageStopped | LogError::DamagedStore { .. }
        ) {
            return error;
        }
        let mut noted = error.clone();
        self.0.send_if_modified(|first| {
            let is_first = first.is_none();
            if is_first {
                error!(%error, "the log has failed");
            }
            noted = first.get_or_insert(error).clone();
            is_first
        });
        noted
    }

    /// Replaces the failure by the disk's error, if the store gave no cause.
    pub(super) fn explain(&self, why: &LogError) {
        self.0.send_if_modified(|first| {
            let explained = *first == Some(LogError::StorageStopped);
            if explained {
                *first = Some(why.clone());
            }
            explained
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn storage(what: &str) -> LogError {
        LogError::Storage { what: what.into() }
    }

    #[test]
    fn the_first_failure_stays() {
        let (full, broken) = (storage("no room"), storage("broken"));
        let failure = Failure::default();
        assert_eq!(failure.note(LogError::Closed), LogError::Closed);
        failure.explain(&broken);
        assert_eq!(failure.get(), None);
        assert_eq!(failure.note(full.clone()), full);
        for later in [broken.clone(), LogError::StorageStopped] {
            assert_eq!(failure.note(later.clone()), full);
            failure.explain(&later);
        }
        assert_eq!(failure.note(LogError::Closed), LogError::Closed);
        assert_eq!(failure.get(), Some(full.clone()));

        let failure = Failure::default();
        let stopped = LogError::StorageStopped;
        assert_eq!(failure.note(stopped.clone()), stopped);
        for why in [&full, &broken] {
            failure.explain(why);
            assert_eq!(failure.get(), Some(full.clone()));
        }
    }
}
