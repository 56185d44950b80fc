//! Admission control: a bound on the calls in flight of one face (gRPC or Zenoh).

use std::sync::Arc;

use tokio::sync::{OwnedSemaphorePermit, Semaphore};

/// The call slots of one face. Clones share them.
#[derive(Clone, Debug)]
pub(crate) struct Admission {
    limit: usize,
    free: Arc<Semaphore>,
}

impl Admission {
    /// Admits up to `limit` calls at a time.
    pub(crate) fn new(limit: usize) -> Self {
        let limit = limit.min(Semaphore::MAX_PERMITS);
        Self {
            limit,
            free: Arc::new(Semaphore::new(limit)),
        }
    }

    /// The most calls in flight.
    pub(crate) fn limit(&self) -> usize {
        self.limit
    }

    /// The number of calls in flight.
    pub(crate) fn in_use(&self) -> usize {
        self.limit - self.free.available_permits()
    }

    /// Takes a slot for one call; dropping the permit frees it. None while `limit` calls are in flight.
    pub(crate) fn take(&self) -> Option<OwnedSemaphorePermit> {
        Arc::clone(&self.free).try_acquire_owned().ok()
    }
}
