//! A log that fails on demand. It is a journal in memory. A loss of power leaves what was synced and, perhaps, the
//! first of the rest.
//!
//! It shares no code with the other stores. A random draw decides what a failed call leaves behind: nothing, all of it,
//! or a half.

mod gate;
mod journal;

use std::{collections::BTreeMap, sync::Arc, time::SystemTime};

use futures_util::{FutureExt, future::BoxFuture};
use parking_lot::Mutex;
use rand::RngExt;
use wayfold_server::log::{
    Effects, Entry, Keep, Log, LogError, Operation, Origin, Record, Restoring, StoredPoint, Uid,
    View,
};

use gate::Gate;
use journal::{Item, Journal, Points};

/// See the module.
#[derive(Clone)]
pub(crate) struct FaultLog(Arc<Mutex<Journal>>, Arc<Gate>);

impl FaultLog {
    /// An empty log; `seed` draws what is left after a failure.
    pub(crate) fn new(seed: u64) -> Self {
        Self(Arc::new(Mutex::new(Journal::new(seed))), Arc::default())
    }

    /// The gate that every read of points and records passes.
    pub(crate) fn gate(&self) -> &Gate {
        &self.1
    }

    /// Lets the writing call after this many others fail.
    pub(crate) fn fail_after(&self, calls: u64) {
        self.0.lock().fails = Some(calls);
    }

    /// Cuts the power: the journal keeps its synced items, or a little more.
    pub(crate) fn cut(&self) {
        let mut journal = self.0.lock();
        let (synced, written) = (journal.synced, journal.items.len());
        let left = journal.random.random_range(synced..=written);
        journal.open(left);
    }

    /// Closes and opens it in order: nothing is lost.
    pub(crate) fn close_and_open(&self) {
        let mut journal = self.0.lock();
        let written = journal.items.len();
        journal.open(written);
    }
}

impl Log for FaultLog {
    fn indexes(&self) -> Result<Vec<Entry>, LogError> {
        let journal = self.0.lock();
        Ok(journal
            .indexes
            .values()
            .map(|index| index.entry.clone())
            .collect())
    }

    fn create(&self, entry: Entry) -> Result<(), LogError> {
        self.0
            .lock()
            .create(entry, Origin::START, Points::default())
    }

    fn restore(&self, entry: Entry, origin: Origin) -> Result<Box<dyn Restoring>, LogError> {
        Ok(Box::new(Copy {
            log: self.clone(),
            entry,
            origin,
            points: BTreeMap::new(),
        }))
    }

    fn delete(&self, uid: Uid) -> Result<(), LogError> {
        let mut journal = self.0.lock();
        journal.index(uid)?;
        journal.write_and_sync(Item::Delete(uid))
    }

    fn append(&self, uid: Uid, expected: u64, effects: Effects) -> Result<Arc<Record>, LogError> {
        // It does this like a store that sums up its points: it reads those that go.
        let next_id = self.0.lock().index(uid)?.next_id;
        let replaces = effects.stored().iter().any(|point| point.id < next_id);
        if replaces || !effects.removed().is_empty() {
            self.1.pass();
        }
        let mut journal = self.0.lock();
        let index = journal.index(uid)?;
        if index.head != expected {
            let head = index.head;
            return Err(LogError::Fenced {
                uid,
                expected,
                head,
            });
        }
        let now = SystemTime::now()
            .duration_since(SystemTime::UNIX_EPOCH)
            .unwrap();
        let now = u64::try_from(now.as_millis()).unwrap();
        let record = Arc::new(Record::new(expected + 1, index.digest, now, effects));
        journal.write(Item::Append(uid, Arc::clone(&record)))?;
        Ok(record)
    }

    fn synced(&self, uid: Uid, revision: u64) -> BoxFuture<'static, Result<u64, LogError>> {
        let synced = self.0.lock().sync(uid, revision);
        std::future::ready(synced).boxed()
    }

    fn tail(
        &self,
        uid: Uid,
        after: Option<u64>,
        most: usize,
    ) -> Result<Vec<Arc<Record>>, LogError> {
        self.1.pass();
        let journal = self.0.lock();
        let index = journal.index(uid)?;
        let oldest = index.head - index.records.len() as u64;
        let after = after.unwrap_or(oldest);
        if after < oldest {
            return Err(LogError::Trimmed { uid, after, oldest });
        }
        let mut records = Vec::new();
        let mut bytes = 0;
        for record in &index.records {
            bytes += if record.revision() > after {
                record.effects().bytes()
            } else {
                0
            };
            if record.revision() > after && (records.is_empty() || bytes <= most) {
                records.push(Arc::clone(record));
            }
        }
        Ok(records)
    }

    fn points(&self, uid: Uid) -> Result<Arc<dyn View>, LogError> {
        let journal = self.0.lock();
        let index = journal.index(uid)?;
        Ok(Arc::new(Pinned {
            log: self.clone(),
            opened: journal.opened,
            revision: index.head,
            next_id: index.next_id,
            points: Arc::clone(&index.points),
        }))
    }

    fn operations(&self, uid: Uid) -> Result<Vec<Arc<Operation>>, LogError> {
        let journal = self.0.lock();
        Ok(journal.index(uid)?.operations.iter().cloned().collect())
    }

    fn trim(&self, uid: Uid, keep: &Keep) -> Result<(), LogError> {
        let mut journal = self.0.lock();
        let (records, operations) = journal.index(uid)?.outdated(keep);
        match records + operations {
            0 => Ok(()),
            _ => journal.write(Item::Trim(uid, records, operations)),
        }
    }

    fn failure(&self) -> Option<LogError> {
        self.0.lock().failed.clone()
    }

    /// After a failure, the journal keeps its synced items and, perhaps, the first of the others.
    fn reopen(&self) -> Result<(), LogError> {
        if self.failure().is_some() {
            self.cut();
        }
        Ok(())
    }
}

/// An index in the making. Each addition to it is a writing call of its own, and no reader sees it.
struct Copy {
    log: FaultLog,
    entry: Entry,
    origin: Origin,
    points: BTreeMap<u64, Arc<StoredPoint>>,
}

impl Restoring for Copy {
    fn add(&mut self, points: &[StoredPoint]) -> Result<(), LogError> {
        self.log.0.lock().called()?;
        let points = points
            .iter()
            .map(|point| (point.id, Arc::new(point.clone())));
        self.points.extend(points);
        Ok(())
    }

    fn finish(self: Box<Self>) -> Result<(), LogError> {
        let mut journal = self.log.0.lock();
        journal.create(self.entry, self.origin, Arc::new(self.points))
    }
}

/// A view. It ends when the log is reopened.
struct Pinned {
    log: FaultLog,
    opened: u64,
    revision: u64,
    next_id: u64,
    points: Points,
}

impl Pinned {
    fn points(&self) -> Result<&BTreeMap<u64, Arc<StoredPoint>>, LogError> {
        self.log.1.pass();
        match self.log.0.lock().opened == self.opened {
            true => Ok(&self.points),
            false => Err(LogError::Closed),
        }
    }
}

impl View for Pinned {
    fn revision(&self) -> u64 {
        self.revision
    }

    fn next_id(&self) -> u64 {
        self.next_id
    }

    fn get(&self, id: u64) -> Result<Option<Arc<StoredPoint>>, LogError> {
        Ok(self.points()?.get(&id).cloned())
    }

    fn page(&self, after: Option<u64>, limit: usize) -> Result<Vec<Arc<StoredPoint>>, LogError> {
        let points = self.points()?.iter();
        let later = points.filter(|(id, _)| after.is_none_or(|after| **id > after));
        Ok(later
            .take(limit)
            .map(|(_, point)| Arc::clone(point))
            .collect())
    }
}
