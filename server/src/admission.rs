//! Admission control: bounds on the calls in flight of one face (gRPC or Zenoh), and on the bytes that they hold.

use std::sync::{
    Arc,
    atomic::{AtomicUsize, Ordering::Relaxed},
};

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

/// A bound on bytes that are held at a time.
#[derive(Debug)]
pub(crate) struct ByteBudget {
    max: usize,
    held: AtomicUsize,
}

impl ByteBudget {
    /// Room for `max` bytes.
    pub(crate) fn new(max: usize) -> Self {
        let held = AtomicUsize::new(0);
        Self { max, held }
    }

    /// The most bytes.
    pub(crate) fn max(&self) -> usize {
        self.max
    }

    /// Takes room for more bytes, until they are given back; false if there is not enough.
    pub(crate) fn take(&self, bytes: usize) -> bool {
        let add = |held: usize| held.checked_add(bytes).filter(|held| *held <= self.max);
        self.held.fetch_update(Relaxed, Relaxed, add).is_ok()
    }

    /// Gives back room that was taken.
    pub(crate) fn give_back(&self, bytes: usize) {
        self.held.fetch_sub(bytes, Relaxed);
    }
}
