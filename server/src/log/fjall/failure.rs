//! The first failure of a store, after which nothing is written. It is logged once.
//!
//! After one of its own threads has failed, fjall says only that it has. The disk's own error, or a damaged block that a full
//! read finds, is the better reason.

use parking_lot::Mutex;
use tracing::error;

use super::store::UNTOLD;
use crate::log::LogError;

/// See the module.
#[derive(Default)]
pub(super) struct Failure(Mutex<Option<LogError>>);

impl Failure {
    /// What it is, if there is one.
    pub(super) fn get(&self) -> Option<LogError> {
        self.0.lock().clone()
    }

    /// Takes note of an error, after which, if it is one of the store and the first, nothing is written any more. What
    /// to tell of it: of errors of the store the first, from which the others follow.
    pub(super) fn note(&self, error: LogError) -> LogError {
        if !matches!(
            error,
            LogError::Storage { .. } | LogError::DamagedStore { .. }
        ) {
            return error;
        }
        let mut first = self.0.lock();
        if first.is_none() {
            error!(%error, "the log has failed");
        }
        first.get_or_insert(error).clone()
    }

    /// Takes what the disk says for the reason, if the store has not told any.
    pub(super) fn explain(&self, why: &LogError) {
        let mut first = self.0.lock();
        if first.as_ref().is_some_and(is_untold) {
            *first = Some(why.clone());
        }
    }
}

/// True if fjall only said that it has failed.
pub(super) fn is_untold(error: &LogError) -> bool {
    matches!(error, LogError::Storage { what } if what == UNTOLD)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn storage(what: &str) -> LogError {
        LogError::Storage { what: what.into() }
    }

    #[test]
    fn the_first_reason_that_is_told_stays() {
        let (full, broken) = (storage("no room"), storage("broken"));
        let failure = Failure::default();
        assert_eq!(failure.note(LogError::Closed), LogError::Closed);
        failure.explain(&broken);
        assert_eq!(failure.get(), None);
        assert_eq!(failure.note(full.clone()), full);
        for later in [broken.clone(), storage(UNTOLD)] {
            assert_eq!(failure.note(later.clone()), full);
            failure.explain(&later);
        }
        assert_eq!(failure.note(LogError::Closed), LogError::Closed);
        assert_eq!(failure.get(), Some(full.clone()));

        let failure = Failure::default();
        assert_eq!(failure.note(storage(UNTOLD)), storage(UNTOLD));
        for why in [&full, &broken] {
            failure.explain(why);
            assert_eq!(failure.get(), Some(full.clone()));
        }
    }
}
