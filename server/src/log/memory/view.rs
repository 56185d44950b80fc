//! The points of one revision in memory.

use std::sync::Arc;

use super::store::{Head, Store};
use crate::log::{LogError, RecordPosition, Sessions, StoredPoint, View};

/// A view. The versions it sees stay while it is held.
pub(super) struct PinnedView {
    pub(super) store: Arc<Store>,
    pub(super) head: Head,
}

impl View for PinnedView {
    fn position(&self) -> RecordPosition {
        self.head.position
    }

    fn next_id(&self) -> u64 {
        self.head.next_id
    }

    fn sessions(&self) -> &Sessions {
        &self.head.sessions
    }

    fn get(&self, id: u64) -> Result<Option<Arc<StoredPoint>>, LogError> {
        Ok(self
            .store
            .versions
            .read()
            .get(id, self.head.position.revision)
            .cloned())
    }

    fn page(&self, after: Option<u64>, limit: usize) -> Result<Vec<Arc<StoredPoint>>, LogError> {
        let versions = self.store.versions.read();
        Ok(versions.page(after, limit, self.head.position.revision))
    }
}

impl Drop for PinnedView {
    fn drop(&mut self) {
        self.store
            .versions
            .write()
            .unpin(self.head.position.revision);
        self.store.collect();
    }
}
