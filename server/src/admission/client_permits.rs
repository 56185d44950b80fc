//! The calls of one client wait for its permits among themselves, so that calls of others do not wait behind all of them.

use std::{
    collections::HashMap,
    sync::{
        Arc, Weak,
        atomic::{AtomicU64, Ordering::Relaxed},
    },
};

use parking_lot::Mutex;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};

use super::MAX_CHANGES;

/// The number of the next client.
static NEXT: AtomicU64 = AtomicU64::new(0);

/// The key of a write permit: the uid of an index and, if another server forwarded the call, the number of its client there.
type WriteKey = ([u8; 16], Option<u64>);

/// The permits of one client: of the calls of one flow.
#[derive(Debug)]
pub struct ClientPermits {
    number: u64,
    reads: Arc<Semaphore>,
    changes: Arc<Semaphore>,
    /// Held by the change that waits in the queue of all.
    next_change: tokio::sync::Mutex<()>,
    writes: Mutex<HashMap<WriteKey, Weak<Semaphore>>>,
}

impl ClientPermits {
    /// At most `reads` reads of stored points at a time.
    pub fn new(reads: usize) -> Self {
        Self {
            number: NEXT.fetch_add(1, Relaxed),
            reads: Arc::new(Semaphore::new(reads)),
            changes: Arc::new(Semaphore::new(MAX_CHANGES / 4)),
            next_change: tokio::sync::Mutex::new(()),
            writes: Mutex::default(),
        }
    }

    /// A number that no other client of this process has.
    pub(crate) fn number(&self) -> u64 {
        self.number
    }

    /// Waits until the client may read stored points.
    pub(crate) async fn read(&self) -> Option<OwnedSemaphorePermit> {
        // It is never closed.
        Arc::clone(&self.reads).acquire_owned().await.ok()
    }

    /// Waits until the client may create, delete or restore an index, and then for `all` clients: it has a quarter of all
    /// permits, and one place in their queue.
    pub(crate) async fn change<T>(
        &self,
        all: impl Future<Output = T>,
    ) -> (Option<OwnedSemaphorePermit>, T) {
        // It is never closed.
        let share = Arc::clone(&self.changes).acquire_owned().await.ok();
        let _next = self.next_change.lock().await;
        (share, all.await)
    }

    /// Waits until no other call of the client waits for the writer of this index. The writer takes calls in the order of
    /// arrival, and one client may have hundreds of long ones. All clients of another server have one connection here, so each
    /// of them, by its number there, waits apart.
    pub(crate) async fn write(
        &self,
        uid: [u8; 16],
        forwarded_client: Option<u64>,
    ) -> Option<OwnedSemaphorePermit> {
        let key = (uid, forwarded_client);
        let permit = {
            let mut writes = self.writes.lock();
            let known = writes.get(&key).and_then(Weak::upgrade);
            known.unwrap_or_else(|| {
                writes.retain(|_, permit| permit.strong_count() > 0);
                let permit = Arc::new(Semaphore::new(1));
                writes.insert(key, Arc::downgrade(&permit));
                permit
            })
        };
        permit.acquire_owned().await.ok()
    }
}

#[cfg(test)]
mod tests {
    use std::pin::pin;

    use futures_util::poll;

    use super::*;

    #[tokio::test]
    async fn a_change_waits_for_at_most_one_of_each_other_client() {
        let all = Arc::new(Semaphore::new(1));
        let (many, one) = (ClientPermits::new(1), ClientPermits::new(1));
        let acquire = || Arc::clone(&all).acquire_owned();
        let busy = acquire().await.unwrap();
        let mut first = pin!(many.change(acquire()));
        let mut second = pin!(many.change(acquire()));
        let mut last = pin!(one.change(acquire()));
        assert!(poll!(first.as_mut()).is_pending());
        assert!(poll!(second.as_mut()).is_pending());
        assert!(poll!(last.as_mut()).is_pending());
        drop(busy);
        drop(first.await);
        assert!(poll!(second.as_mut()).is_pending());
        drop(last.await);
        let (share, permit) = second.await;
        assert!(share.is_some() && permit.is_ok());
    }
}
