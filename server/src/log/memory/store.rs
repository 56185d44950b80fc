//! One index in memory: its window of records, and the points that result from all its records.

use std::{collections::VecDeque, sync::Arc};

use futures_util::{StreamExt, stream};
use imbl::OrdMap;
use parking_lot::Mutex;
use tokio::sync::watch;

use super::view::Head;
use crate::log::{
    LogError, Operation, Origin, Record, RecordPosition, RecordStream, Retention, Sessions,
    StoredPoint, Uid, View, Window,
    retention::{Allowance, BoundedQueue},
};

pub(super) struct Store {
    uid: Uid,
    journal: Mutex<Journal>,
    /// The newest revision, or the error after which no further record comes.
    newest: watch::Sender<Result<u64, LogError>>,
}

struct Journal {
    head: Head,
    /// The newest records, without a gap up to the head.
    records: BoundedQueue<Arc<Record>>,
    /// The newest operations.
    operations: BoundedQueue<Arc<Operation>>,
    /// The submitted records that are not yet applied, oldest first, with the heads that they made.
    unapplied: VecDeque<(Arc<Record>, Head)>,
    /// True if another store has taken the place of this one.
    is_replaced: bool,
}

impl Journal {
    /// Writes the record after the head.
    fn write(&mut self, record: &Arc<Record>) {
        self.head.apply(record);
        let bytes = record.effects().bytes();
        self.records.push(Arc::clone(record), bytes);
        if let Some(operation) = record.effects().operation() {
            let bytes = operation.bytes();
            self.operations.push(Arc::clone(operation), bytes);
        }
    }
}

impl Store {
    /// A store that begins with these points.
    pub(super) fn new(
        uid: Uid,
        origin: Origin,
        points: OrdMap<u64, Arc<StoredPoint>>,
        sessions: Sessions,
    ) -> Self {
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
                    points,
                },
                records: BoundedQueue::default(),
                operations: BoundedQueue::default(),
                unapplied: VecDeque::new(),
                is_replaced: false,
            }),
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
        journal.write(&record);
        let head = journal.head.clone();
        let revision = record.revision();
        journal.unapplied.push_back((record, head));
        drop(journal);
        self.announce(revision);
        Ok(())
    }

    /// Applies consecutive records. The store may already have the first ones. Returns the points as of the last
    /// record.
    pub(super) fn apply(&self, records: &[Arc<Record>]) -> Result<Arc<dyn View>, LogError> {
        let mut journal = self.journal.lock();
        if journal.is_replaced {
            return Err(LogError::Closed);
        }
        let Some(last) = records.last() else {
            return Ok(Arc::new(journal.head.clone()));
        };
        let is_applied = |submitted: &mut (Arc<Record>, Head)| {
            let (record, _) = submitted;
            record.revision() <= last.revision()
        };
        while let Some((record, head)) = journal.unapplied.pop_front_if(is_applied) {
            if record.revision() == last.revision() {
                return Ok(Arc::new(head));
            }
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
            journal.write(record);
        }
        if journal.head.position.revision != last.revision() {
            return Err(self.fenced(last.revision(), &journal));
        }
        let head = journal.head.clone();
        drop(journal);
        self.announce(last.revision());
        Ok(Arc::new(head))
    }

    fn fenced(&self, expected: u64, journal: &Journal) -> LogError {
        LogError::Fenced {
            uid: self.uid,
            expected,
            head: journal.head.position.revision,
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

    pub(super) fn view(&self) -> Arc<dyn View> {
        Arc::new(self.journal.lock().head.clone())
    }
}
