//! The points of one revision in memory.

use std::{ops::Bound, sync::Arc};

use imbl::OrdMap;

use crate::log::{LogError, Record, RecordPosition, Sessions, StoredPoint, View};

/// The sum of the records up to one revision. A clone shares its content, and a change copies only what is shared, so
/// that views and the writer need no common lock.
#[derive(Clone)]
pub(super) struct Head {
    pub(super) position: RecordPosition,
    pub(super) next_id: u64,
    pub(super) sessions: Sessions,
    pub(super) points: OrdMap<u64, Arc<StoredPoint>>,
}

impl Head {
    /// Applies the next record.
    pub(super) fn apply(&mut self, record: &Record) {
        let effects = record.effects();
        for id in effects.removed() {
            self.points.remove(id);
        }
        for (slot, point) in effects.stored().iter().enumerate() {
            let stored = Arc::new(StoredPoint {
                id: point.id,
                revision: point.revision,
                modified: record.revision(),
                tag: point.tag,
                state: point.row.into(),
                payload: effects.payload(slot),
            });
            self.points.insert(point.id, stored);
        }
        self.position = record.position();
        self.next_id = self.next_id.max(effects.next_id());
        self.sessions.apply(record);
    }
}

impl View for Head {
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
        Ok(self.points.get(&id).cloned())
    }

    fn page(&self, after: Option<u64>, limit: usize) -> Result<Vec<Arc<StoredPoint>>, LogError> {
        let start = after.map_or(Bound::Unbounded, Bound::Excluded);
        let points = self.points.range((start, Bound::Unbounded)).take(limit);
        Ok(points.map(|(_, point)| Arc::clone(point)).collect())
    }
}
