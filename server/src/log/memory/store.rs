//! One index in memory: its window of records, and the points that result from all its records.

use std::{collections::VecDeque, sync::Arc};

use futures_util::{StreamExt, stream};
use parking_lot::{Mutex, RwLock};
use tokio::sync::watch;

use super::{versions::Versions, view::PinnedView};
use crate::log::{
    LogError, Operation, Origin, Record, RecordPosition, RecordStream, Retention, Sessions,
    StoredPoint, Uid, View, Window,
    retention::{Allowance, BoundedQueue},
};

/// The number of rows that are stored or dropped during one hold of the lock. It keeps a large record from blocking
/// readers of payloads. Dropping a view also collects at most this many unseen versions, so it is short. The rest
/// waits for the next dropped view or the next record. A record collects this number plus twice the rows it changes, so
/// the backlog shrinks.
const ROWS_PER_HOLD: usize = 512;

/// Lock order: journal, versions. Only the holder of the journal adds versions.
pub(super) struct Store {
    uid: Uid,
    journal: Mutex<Journal>,
    pub(super) versions: RwLock<Versions>,
    /// The newest revision, or the error after which no further record comes.
    newest: watch::Sender<Result<u64, LogError>>,
}

struct Journal {
    head: Head,
    /// The newest records, without a gap up to the head.
    records: BoundedQueue<Arc<Record>>,
    /// The newest operations.
    operations: BoundedQueue<Arc<Operation>>,
    /// The submitted records that are not yet applied, oldest first, with the heads that they made. The versions of
    /// the heads are pinned.
    unapplied: VecDeque<(Arc<Record>, Head)>,
    /// True if another store has taken the place of this one.
    is_replaced: bool,
}

/// The newest record, and the sums of all records beside the points.
#[derive(Clone)]
pub(super) struct Head {
    pub(super) position: RecordPosition,
    pub(super) next_id: u64,
    pub(super) sessions: Sessions,
}

impl Store {
    /// A store that begins with these points.
    pub(super) fn new(
        uid: Uid,
        origin: Origin,
        points: Vec<Arc<StoredPoint>>,
        sessions: Sessions,
    ) -> Self {
        let mut versions = Versions::default();
        for point in points {
            versions.insert_new(point);
        }
        versions.advance(origin.revision);
        Self {
            uid,
            journal: Mutex::new(Journal {
                head: Head {
                    position: RecordPosition {
                        revision: origin.revision,
                        digest: origin.digest,
                    },
                    next_id: origin.next_id,
                    sessions,
                },
                records: BoundedQueue::default(),
                operations: BoundedQueue::default(),
                unapplied: VecDeque::new(),
                is_replaced: false,
            }),
            versions: RwLock::new(versions),
            newest: watch::Sender::new(Ok(origin.revision)),
        }
    }

    pub(super) fn submit(&self, record: Arc<Record>) -> Result<(), LogError> {
        let mut journal = self.journal.lock();
        if journal.is_replaced {
            return Err(LogError::Closed);
        }
        if !record.follows(journal.head.position) {
            return Err(self.fenced(record.revision() - 1, &journal));
        }
        self.write(&record, &mut journal);
        self.versions.write().pin(record.revision());
        let head = journal.head.clone();
        let revision = record.revision();
        journal.unapplied.push_back((record, head));
        drop(journal);
        self.announce(revision);
        Ok(())
    }

    /// Applies consecutive records. The store may already have the first ones. Returns the points as of the last
    /// record.
    pub(super) fn apply(
        self: &Arc<Self>,
        records: &[Arc<Record>],
    ) -> Result<Arc<dyn View>, LogError> {
        let mut journal = self.journal.lock();
        if journal.is_replaced {
            return Err(LogError::Closed);
        }
        let Some(last) = records.last() else {
            drop(journal);
            return Ok(Arc::clone(self).pin());
        };
        while let Some((record, head)) = journal.unapplied.pop_front() {
            if head.position.revision == last.revision() {
                return Ok(Arc::new(self.pinned(head)));
            }
            if head.position.revision > last.revision() {
                journal.unapplied.push_front((record, head));
                break;
            }
            self.versions.write().unpin(head.position.revision);
        }
        for record in records {
            if record.revision() <= journal.head.position.revision {
                continue;
            }
            if !record.follows(journal.head.position) {
                return Err(LogError::Damaged {
                    uid: self.uid,
                    revision: record.revision(),
                    what: "it does not follow the record before it",
                });
            }
            self.write(record, &mut journal);
        }
        if journal.head.position.revision != last.revision() {
            return Err(self.fenced(last.revision(), &journal));
        }
        self.versions.write().pin(last.revision());
        let view = self.pinned(journal.head.clone());
        drop(journal);
        self.announce(last.revision());
        Ok(Arc::new(view))
    }

    fn fenced(&self, expected: u64, journal: &Journal) -> LogError {
        LogError::Fenced {
            uid: self.uid,
            expected,
            head: journal.head.position.revision,
        }
    }

    /// Writes the record after the head.
    fn write(&self, record: &Arc<Record>, journal: &mut Journal) {
        let head = &mut journal.head;
        self.store(record, head.next_id);
        head.position = record.position();
        head.next_id = head.next_id.max(record.effects().next_id());
        head.sessions.apply(record);
        let bytes = record.effects().bytes();
        journal.records.push(Arc::clone(record), bytes);
        if let Some(operation) = record.effects().operation() {
            let bytes = operation.bytes();
            journal.operations.push(Arc::clone(operation), bytes);
        }
    }

    fn announce(&self, revision: u64) {
        self.newest.send_if_modified(|newest| {
            let is_newer = newest.as_ref().is_ok_and(|newest| *newest < revision);
            if is_newer {
                *newest = Ok(revision);
            }
            is_newer
        });
    }

    /// Adds operations of records before the first one, oldest first.
    pub(super) fn remember(&self, operations: Vec<Arc<Operation>>) {
        let mut journal = self.journal.lock();
        for operation in operations {
            let bytes = operation.bytes();
            journal.operations.push(operation, bytes);
        }
    }

    /// Takes no record any more, because a copy at the revision `copied` takes its place. Refused unless the copy is
    /// newer.
    pub(super) fn supersede(&self, copied: u64) -> Result<(), LogError> {
        let mut journal = self.journal.lock();
        if copied <= journal.head.position.revision {
            return Err(self.fenced(copied, &journal));
        }
        journal.is_replaced = true;
        drop(journal);
        self.close(LogError::Closed);
        Ok(())
    }

    /// Ends the streams of records.
    pub(super) fn close(&self, why: LogError) {
        let _ = self.newest.send_replace(Err(why));
    }

    /// A stream of the records after the revision `after`.
    pub(super) fn follow(self: Arc<Self>, after: u64) -> RecordStream {
        let newest = self.newest.subscribe();
        let batches = stream::unfold(Some((self, newest, after)), async |follower| {
            let (store, mut newest, after) = follower?;
            let has_news = |newest: &Result<u64, LogError>| match newest {
                Ok(newest) => *newest > after,
                Err(_) => true,
            };
            let seen = newest.wait_for(has_news).await.map(|seen| seen.clone());
            let records = match seen {
                Ok(Ok(_)) => store.read_next(after),
                Ok(Err(why)) => Err(why),
                Err(_) => Err(LogError::Closed),
            };
            let last = records.as_ref().ok().and_then(|records| records.last());
            let next = last.map(|last| last.revision());
            Some((records, next.map(|after| (store, newest, after))))
        });
        batches.boxed()
    }

    /// The records after the revision `after`. Records that were trimmed before they were applied are followed too.
    fn read_next(&self, after: u64) -> Result<Vec<Arc<Record>>, LogError> {
        let unapplied: Vec<_> = {
            let journal = self.journal.lock();
            let unapplied = journal.unapplied.iter().map(|(record, _)| record);
            let next = unapplied.filter(|record| record.revision() > after);
            next.cloned().collect()
        };
        match unapplied.first() {
            Some(first) if first.revision() == after + 1 => Ok(unapplied),
            _ => self.read(Some(after), usize::MAX),
        }
    }

    /// Adds the versions that `record` makes. Views see them only after the head has moved.
    fn store(&self, record: &Record, next_id: u64) {
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
                if point.id >= next_id {
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

    /// Drops some of the versions that no revision sees any more; false if none is left.
    pub(super) fn collect(&self) -> bool {
        self.versions.write().collect(ROWS_PER_HOLD)
    }

    pub(super) fn read(
        &self,
        after: Option<u64>,
        max_bytes: usize,
    ) -> Result<Vec<Arc<Record>>, LogError> {
        let journal = self.journal.lock();
        let oldest = journal.head.position.revision - journal.records.iter().len() as u64;
        let after = after.unwrap_or(oldest);
        if after < oldest {
            return Err(LogError::Trimmed {
                uid: self.uid,
                after,
                oldest,
            });
        }
        let skipped = (after - oldest) as usize;
        let mut left = Allowance::of(max_bytes);
        let records = journal.records.iter().skip(skipped);
        Ok(records
            .take_while(|record| left.take(record))
            .cloned()
            .collect())
    }

    pub(super) fn operations(&self) -> Vec<Arc<Operation>> {
        self.journal.lock().operations.iter().cloned().collect()
    }

    pub(super) fn window(&self) -> Window {
        self.journal.lock().records.window()
    }

    pub(super) fn trim(&self, retention: &Retention) {
        let journal = &mut *self.journal.lock();
        retention
            .forget_records(&mut journal.records, |record| record.time_ms())
            .for_each(drop);
        retention
            .forget_operations(&mut journal.operations)
            .for_each(drop);
    }

    pub(super) fn pin(self: Arc<Self>) -> Arc<dyn View> {
        let journal = self.journal.lock();
        let head = journal.head.clone();
        self.versions.write().pin(head.position.revision);
        drop(journal);
        Arc::new(self.pinned(head))
    }

    /// A view of a pinned revision; it takes over the pin.
    fn pinned(self: &Arc<Self>, head: Head) -> PinnedView {
        PinnedView {
            store: Arc::clone(self),
            head,
        }
    }
}

#[cfg(test)]
mod tests;
