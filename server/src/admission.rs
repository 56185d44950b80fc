//! How many calls of a face may be under way, and how many are.

use std::sync::Arc;

use tokio::sync::{OwnedSemaphorePermit, Semaphore};

/// The room of one face.
#[derive(Clone, Debug)]
pub(crate) struct Admission {
    limit: usize,
    free: Arc<Semaphore>,
}

impl Admission {
    /// Room for `limit` calls.
    pub(crate) fn new(limit: usize) -> Self {
        let limit = limit.min(Semaphore::MAX_PERMITS);
        Self {
            limit,
            free: Arc::new(Semaphore::new(limit)),
        }
    }

    /// Most calls under way.
    pub(crate) fn limit(&self) -> usize {
        self.limit
    }

    /// How many calls are under way.
    pub(crate) fn in_use(&self) -> usize {
        self.limit - self.free.available_permits()
    }

    /// A place for one call, which is free again once it is dropped; none while as many are under way as may be.
    pub(crate) fn take(&self) -> Option<OwnedSemaphorePermit> {
        Arc::clone(&self.free).try_acquire_owned().ok()
    }
}
