//! The points of an index as of one revision.

use std::sync::{Arc, OnceLock};

use fjall::{Readable, Snapshot};

use super::{
    layout::{Number, point_key},
    point,
    store::{Handles, Store, unreadable},
};
use crate::log::{LogError, RecordPosition, Sessions, StoredPoint, Uid, View};

/// The points of one revision. While this is the newest revision, the view reads the current store and holds no
/// snapshot: a snapshot makes fjall keep all data that is overwritten in any index.
pub(super) struct PointsView {
    pub(super) store: Arc<Store>,
    /// Taken just before the next write to the index, and held until the view is dropped or the store is closed.
    pub(super) frozen: OnceLock<Snapshot>,
    pub(super) number: Number,
    pub(super) uid: Uid,
    pub(super) position: RecordPosition,
    pub(super) next_id: u64,
    pub(super) sessions: Sessions,
}

impl PointsView {
    /// Keeps the current content of the store. The caller is about to write to the index and is its only writer.
    pub(super) fn freeze(&self, handles: &Handles) {
        self.frozen.get_or_init(|| handles.database.snapshot());
    }

    /// A snapshot of this revision.
    fn snapshot(&self, handles: &Handles) -> Snapshot {
        // Taken before `frozen` is read: an unfrozen view was not yet overwritten then.
        let newest = handles.database.snapshot();
        self.frozen.get().cloned().unwrap_or(newest)
    }
}

impl View for PointsView {
    fn position(&self) -> RecordPosition {
        self.position
    }

    fn next_id(&self) -> u64 {
        self.next_id
    }

    fn sessions(&self) -> &Sessions {
        &self.sessions
    }

    fn get(&self, id: u64) -> Result<Option<Arc<StoredPoint>>, LogError> {
        let handles = self.store.handles()?;
        let key = point_key(self.number, id);
        let value = self.snapshot(&handles).get(&handles.keyspace, key);
        let value = value.map_err(|error| unreadable(self.uid, error))?;
        let point = value.map(|value| point::read(self.number, self.uid, id, &value));
        Ok(point.transpose()?.map(Arc::new))
    }

    fn page(&self, after: Option<u64>, limit: usize) -> Result<Vec<Arc<StoredPoint>>, LogError> {
        self.page_within(after, limit, usize::MAX)
    }

    // One range for the whole page: its first point is found in every table of the store.
    fn page_within(
        &self,
        after: Option<u64>,
        limit: usize,
        max_bytes: usize,
    ) -> Result<Vec<Arc<StoredPoint>>, LogError> {
        let first = match after {
            Some(u64::MAX) => return Ok(Vec::new()),
            Some(id) => id + 1,
            None => 0,
        };
        let range = point_key(self.number, first)..=point_key(self.number, u64::MAX);
        let handles = self.store.handles()?;
        let points = self.snapshot(&handles).range(&handles.keyspace, range);
        let (mut page, mut bytes) = (Vec::new(), 0);
        for point in points.take(limit) {
            let (key, value) = point
                .into_inner()
                .map_err(|error| unreadable(self.uid, error))?;
            let point = point::read_entry(self.number, self.uid, (&key, &value))?;
            bytes += point.bytes();
            page.push(Arc::new(point));
            if bytes >= max_bytes {
                break;
            }
        }
        Ok(page)
    }
}
