//! The calls of one client wait for its permits among themselves, so that calls of others do not wait behind all of them.

use std::{
    collections::HashMap,
    sync::{Arc, Weak},
};

use parking_lot::Mutex;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};

use super::MAX_CHANGES;

/// The permits of one client: of the calls of one flow.
#[derive(Debug)]
pub struct ClientPermits {
    reads: Arc<Semaphore>,
    changes: Arc<Semaphore>,
    /// By the uid of an index.
    writes: Mutex<HashMap<[u8; 16], Weak<Semaphore>>>,
}

impl ClientPermits {
    /// At most `reads` reads of stored points at a time.
    pub fn new(reads: usize) -> Self {
        Self {
            reads: Arc::new(Semaphore::new(reads)),
            changes: Arc::new(Semaphore::new(MAX_CHANGES / 4)),
            writes: Mutex::default(),
        }
    }

    /// Waits until the client may read stored points.
    pub(crate) async fn read(&self) -> Option<OwnedSemaphorePermit> {
        // It is never closed.
        Arc::clone(&self.reads).acquire_owned().await.ok()
    }

    /// Waits until the client may create, delete or restore an index: it has a quarter of all permits.
    pub(crate) async fn change(&self) -> Option<OwnedSemaphorePermit> {
        // It is never closed.
        Arc::clone(&self.changes).acquire_owned().await.ok()
    }

    /// Waits until no other call of the client waits for the writer of this index. The writer takes calls in the order of
    /// arrival, and one client may have hundreds of long ones.
    pub(crate) async fn write(&self, uid: [u8; 16]) -> Option<OwnedSemaphorePermit> {
        let permit = {
            let mut writes = self.writes.lock();
            let known = writes.get(&uid).and_then(Weak::upgrade);
            known.unwrap_or_else(|| {
                writes.retain(|_, permit| permit.strong_count() > 0);
                let permit = Arc::new(Semaphore::new(1));
                writes.insert(uid, Arc::downgrade(&permit));
                permit
            })
        };
        permit.acquire_owned().await.ok()
    }
}
