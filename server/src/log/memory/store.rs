//! One index in memory: its window of records, and the points that all its records amount to.

use std::{collections::VecDeque, sync::Arc, time::SystemTime};

use parking_lot::{Mutex, RwLock};

use super::versions::Versions;
use crate::log::{
    Digest, Effects, Keep, LogError, Operation, Origin, Record, StoredPoint, Uid, View,
    record::time_ms,
    window::{Allowance, Window},
};

/// How many rows are stored or dropped under one hold of the lock, so that a large record does not keep readers from
/// payloads. Also the most that whoever lets go of a view drops of what nobody sees any more, a fraction of a
/// millisecond: the rest waits for the next view that is let go of, and for the next record, which looks after one such
/// hold and twice as many rows as it changes, so that less and less waits.
const ROWS_PER_HOLD: usize = 512;

/// Locks are taken in the order journal, versions. Only the holder of the journal adds versions.
pub(super) struct Store {
    uid: Uid,
    journal: Mutex<Journal>,
    versions: RwLock<Versions>,
}

struct Journal {
    head: u64,
    digest: Digest,
    next_id: u64,
    /// The newest records, without a gap up to the head.
    records: VecDeque<Arc<Record>>,
    /// The newest operations.
    operations: VecDeque<Arc<Operation>>,
    window: Window,
}

impl Store {
    /// A store that begins with these points.
    pub(super) fn new(uid: Uid, origin: Origin, points: Vec<Arc<StoredPoint>>) -> Self {
        let mut versions = Versions::default();
        for point in points {
            versions.insert_new(point);
        }
        versions.advance(origin.revision);
        Self {
            uid,
            journal: Mutex::new(Journal {
                head: origin.revision,
                digest: origin.digest,
                next_id: origin.next_id,
                records: VecDeque::new(),
                operations: VecDeque::new(),
                window: Window::default(),
            }),
            versions: RwLock::new(versions),
        }
    }

    pub(super) fn append(&self, expected: u64, effects: Effects) -> Result<Arc<Record>, LogError> {
        let mut journal = self.journal.lock();
        if journal.head != expected {
            return Err(LogError::Fenced {
                uid: self.uid,
                expected,
                head: journal.head,
            });
        }
        let now = time_ms(SystemTime::now());
        let record = Arc::new(Record::new(expected + 1, journal.digest, now, effects));
        self.store(&record, &mut journal.next_id);
        journal.head = record.revision();
        journal.digest = *record.digest();
        journal.window.hold(&record);
        journal.records.push_back(Arc::clone(&record));
        if let Some(operation) = record.effects().operation() {
            journal.window.hold_operation(operation.bytes());
            journal.operations.push_back(Arc::clone(operation));
        }
        Ok(record)
    }

    /// Adds the versions that `record` makes. No view sees one before the head has moved.
    fn store(&self, record: &Record, next_id: &mut u64) {
        let effects = record.effects();
        for ids in effects.removed().chunks(ROWS_PER_HOLD) {
            let mut versions = self.versions.write();
            for &id in ids {
                versions.remove(id, record.revision());
            }
        }
        let stored = effects.stored();
        for start in (0..stored.len()).step_by(ROWS_PER_HOLD) {
            let mut versions = self.versions.write();
            for slot in start..stored.len().min(start + ROWS_PER_HOLD) {
                let point = stored.get(slot);
                let version = Arc::new(StoredPoint {
                    id: point.id,
                    revision: point.revision,
                    modified: record.revision(),
                    tag: point.tag,
                    state: point.row.into(),
                    payload: effects.payload(slot),
                });
                if point.id >= *next_id {
                    *next_id = point.id + 1;
                    versions.insert_new(version);
                } else {
                    versions.insert(version);
                }
            }
        }
        self.versions.write().advance(record.revision());
        for _ in 0..=(2 * effects.len()).div_ceil(ROWS_PER_HOLD) {
            if !self.collect() {
                break;
            }
        }
    }

    /// Drops some of what nobody sees any more; false if nothing of it is left.
    fn collect(&self) -> bool {
        self.versions.write().collect(ROWS_PER_HOLD)
    }

    pub(super) fn tail(
        &self,
        after: Option<u64>,
        most: usize,
    ) -> Result<Vec<Arc<Record>>, LogError> {
        let journal = self.journal.lock();
        let oldest = journal.head - journal.records.len() as u64;
        let after = after.unwrap_or(oldest);
        if after < oldest {
            return Err(LogError::Trimmed {
                uid: self.uid,
                after,
                oldest,
            });
        }
        let skipped = (after - oldest) as usize;
        let mut left = Allowance::of(most);
        let records = journal.records.iter().skip(skipped);
        Ok(records
            .take_while(|record| left.take(record))
            .cloned()
            .collect())
    }

    pub(super) fn operations(&self) -> Vec<Arc<Operation>> {
        self.journal.lock().operations.iter().cloned().collect()
    }

    pub(super) fn trim(&self, keep: &Keep) {
        let mut journal = self.journal.lock();
        let trimmed = journal.window.trim(keep);
        journal.records.drain(..trimmed.records);
        journal.operations.drain(..trimmed.operations);
    }

    pub(super) fn pin(self: Arc<Self>) -> Arc<dyn View> {
        let journal = self.journal.lock();
        let (revision, next_id) = (journal.head, journal.next_id);
        self.versions.write().pin(revision);
        drop(journal);
        Arc::new(Pinned {
            store: self,
            revision,
            next_id,
        })
    }
}

/// A view; while it is held, the versions it sees stay.
struct Pinned {
    store: Arc<Store>,
    revision: u64,
    next_id: u64,
}

impl View for Pinned {
    fn revision(&self) -> u64 {
        self.revision
    }

    fn next_id(&self) -> u64 {
        self.next_id
    }

    fn get(&self, id: u64) -> Result<Option<Arc<StoredPoint>>, LogError> {
        Ok(self.store.versions.read().get(id, self.revision).cloned())
    }

    fn page(&self, after: Option<u64>, limit: usize) -> Result<Vec<Arc<StoredPoint>>, LogError> {
        let versions = self.store.versions.read();
        Ok(versions.page(after, limit, self.revision))
    }
}

impl Drop for Pinned {
    fn drop(&mut self) {
        self.store.versions.write().unpin(self.revision);
        self.store.collect();
    }
}

#[cfg(test)]
mod tests {
    use bytes::Bytes;
    use wayfold_index::PointRef;

    use super::*;
    use crate::log::Outcome;

    fn storing(ids: std::ops::Range<u64>, revision: u64) -> Effects {
        let mut effects = Effects::new(1);
        for id in ids {
            let point = PointRef {
                id,
                tag: 0,
                revision,
                row: &[0.0],
            };
            effects.store(point, Outcome::Inserted, Bytes::new());
        }
        effects
    }

    #[test]
    fn only_what_a_view_sees_is_kept_beside_the_points() {
        let store = Arc::new(Store::new(Uid::unique(), Origin::START, Vec::new()));
        let versions = || store.versions.read().len();
        for revision in 1..=3 {
            store
                .append(revision - 1, storing(0..2000, revision))
                .unwrap();
            assert_eq!(versions(), 2000);
        }
        let view = Arc::clone(&store).pin();
        store.append(3, storing(0..2000, 4)).unwrap();
        assert_eq!(versions(), 4000);
        let mut effects = Effects::new(1);
        (0..1500).for_each(|id| effects.remove(id));
        store.append(4, effects).unwrap();
        // Each of the view's versions, and a version or a mark of each point in the place of it.
        assert_eq!(versions(), 4000);
        drop(view);
        while store.collect() {}
        assert_eq!(versions(), 500);
    }

    #[test]
    fn an_old_view_keeps_no_version_that_it_does_not_see() {
        let store = Arc::new(Store::new(Uid::unique(), Origin::START, Vec::new()));
        let versions = || store.versions.read().len();
        store.append(0, storing(0..2000, 1)).unwrap();
        let old = Arc::clone(&store).pin();
        let mut newest = Arc::clone(&store).pin();
        for revision in 2..30 {
            store
                .append(revision - 1, storing(0..2000, revision))
                .unwrap();
            newest = Arc::clone(&store).pin();
            // The points, what the old view sees, and what was superseded just now.
            assert!(versions() <= 3 * 2000, "{}", versions());
        }
        drop(newest);
        while store.collect() {}
        assert_eq!(versions(), 2 * 2000);
        assert_eq!(old.page(None, 3000).unwrap().len(), 2000);
    }

    #[test]
    fn letting_go_of_a_view_leaves_most_of_the_work_to_later_records() {
        let store = Arc::new(Store::new(Uid::unique(), Origin::START, Vec::new()));
        let versions = || store.versions.read().len();
        store.append(0, storing(0..20_000, 1)).unwrap();
        let old = Arc::clone(&store).pin();
        store.append(1, storing(0..20_000, 2)).unwrap();
        drop(old);
        let waiting = versions() - 20_000;
        assert_eq!(waiting, 20_000 - ROWS_PER_HOLD);
        for revision in 3.. {
            if versions() == 20_000 {
                break;
            }
            let before = versions();
            store
                .append(revision - 1, storing(0..10, revision))
                .unwrap();
            assert!(versions() < before);
        }
    }
}
