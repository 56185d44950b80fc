//! The points of an index, pinned by a snapshot of the store.

use std::sync::Arc;

use fjall::{Readable, Snapshot};

use super::{
    layout::{Number, last_of, point_key},
    point,
    store::{Store, unreadable},
};
use crate::log::{LogError, StoredPoint, Tip, Uid, View};

/// See the module. The snapshot keeps what it sees, whatever is written meanwhile, until the store is closed.
pub(super) struct Pinned {
    pub(super) store: Arc<Store>,
    pub(super) snapshot: Snapshot,
    pub(super) number: Number,
    pub(super) uid: Uid,
    pub(super) tip: Tip,
    pub(super) next_id: u64,
}

impl Pinned {
    fn decode(&self, id: u64, value: &[u8]) -> Result<Arc<StoredPoint>, LogError> {
        point::decode(self.number, id, value)
            .map(Arc::new)
            .ok_or(LogError::DamagedPoint {
                uid: self.uid,
                id,
                what: "it does not match its checksum",
            })
    }
}

impl View for Pinned {
    fn tip(&self) -> Tip {
        self.tip
    }

    fn next_id(&self) -> u64 {
        self.next_id
    }

    fn get(&self, id: u64) -> Result<Option<Arc<StoredPoint>>, LogError> {
        let handles = self.store.handles()?;
        let key = point_key(self.number, id);
        let value = self.snapshot.get(&handles.keyspace, key);
        let value = value.map_err(|error| unreadable(self.uid, error))?;
        value.map(|value| self.decode(id, &value)).transpose()
    }

    fn page(&self, after: Option<u64>, limit: usize) -> Result<Vec<Arc<StoredPoint>>, LogError> {
        let first = match after {
            Some(u64::MAX) => return Ok(Vec::new()),
            Some(id) => id + 1,
            None => 0,
        };
        let range = point_key(self.number, first)..=point_key(self.number, u64::MAX);
        let handles = self.store.handles()?;
        let points = self.snapshot.range(&handles.keyspace, range);
        let page = points.take(limit).map(|point| {
            let (key, value) = point
                .into_inner()
                .map_err(|error| unreadable(self.uid, error))?;
            let id = last_of(&key).ok_or_else(|| LogError::Unreadable {
                uid: self.uid,
                what: "a key of no known form".into(),
            })?;
            self.decode(id, &value)
        });
        page.collect()
    }
}
