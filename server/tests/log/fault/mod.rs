//! A log that fails on demand. It is a journal in memory. A loss of power leaves what was synced and, perhaps, the
//! first of the rest.
//!
//! It shares no code with the other stores. A random draw decides what a failed call leaves behind: nothing, all of it,
//! or a half.

mod gate;
mod journal;
mod view;

use std::{collections::BTreeMap, sync::Arc};

use futures_util::{StreamExt, stream};
use parking_lot::Mutex;
use rand::RngExt;
use tokio::sync::watch;
use wayfold_server::log::{
    self, Catalogue, Entry, LogError, Operation, Origin, PointStore, PointWriter, Receipt, Record,
    RecordPosition, RecordStream, Retention, Sessions, StoredPoint, Uid, View, Window,
};

use gate::Gate;
use journal::{Item, Journal, Sum};
use view::PinnedView;

/// A log that fails on demand; see the module.
#[derive(Clone)]
pub(crate) struct FaultLog(Arc<Mutex<Journal>>, Arc<Gate>, watch::Sender<()>);

impl FaultLog {
    /// An empty log; `seed` determines what remains after a failure.
    pub(crate) fn new(seed: u64) -> Self {
        let journal = Arc::new(Mutex::new(Journal::new(seed)));
        Self(journal, Arc::default(), watch::Sender::new(()))
    }

    /// The gate that every read of points and records passes.
    pub(crate) fn gate(&self) -> &Gate {
        &self.1
    }

    /// Makes the writing call after this many others fail.
    pub(crate) fn fail_after(&self, calls: u64) {
        self.0.lock().fails = Some(calls);
    }

    /// Cuts the power: the journal keeps its synced items, or a little more.
    pub(crate) fn cut(&self) {
        let mut journal = self.0.lock();
        let (synced, written) = (journal.synced, journal.items.len());
        let left = journal.random.random_range(synced..=written);
        journal.open(left);
        self.2.send_replace(());
    }

    /// Closes and opens it in order, without loss.
    pub(crate) fn close_and_open(&self) {
        let mut journal = self.0.lock();
        let written = journal.items.len();
        journal.open(written);
        self.2.send_replace(());
    }
}

impl log::Journal for FaultLog {
    fn submit(&self, uid: Uid, record: Arc<Record>) -> Result<Receipt, LogError> {
        let effects = record.effects();
        // Like a store that keeps a sum over its points, it reads the points that it replaces and removes.
        if !effects.only_adds() {
            self.1.pass();
        }
        let mut journal = self.0.lock();
        let index = journal.index(uid)?;
        if (index.head + 1, &index.digest) != (record.revision(), record.previous()) {
            return Err(LogError::fenced(uid, record.revision() - 1, index.head));
        }
        journal.write(Item::Append(uid, Arc::clone(&record)))?;
        let index = journal.indexes.get_mut(&uid).unwrap();
        let unapplied = (record, Arc::clone(&index.sum));
        index.unapplied.push_back(unapplied);
        drop(journal);
        self.2.send_replace(());
        Ok(Receipt::Accepted)
    }

    /// Each batch is synced when a caller waits for it.
    fn follow(&self, uid: Uid, after: u64) -> RecordStream {
        let opened = self.0.lock().opened;
        let follower = (self.clone(), self.2.subscribe(), after);
        let batches = stream::unfold(Some(follower), move |follower| async move {
            let (log, mut changed, after) = follower?;
            loop {
                changed.borrow_and_update();
                let news = log.synced_after(uid, after, opened);
                match news {
                    Ok(records) if records.is_empty() => {}
                    Ok(records) => {
                        let after = records.last().unwrap().revision();
                        return Some((Ok(records), Some((log, changed, after))));
                    }
                    Err(why) => return Some((Err(why), None)),
                }
                if changed.changed().await.is_err() {
                    return None;
                }
            }
        });
        batches.boxed()
    }

    fn newest(&self, uid: Uid) -> Result<u64, LogError> {
        Ok(self.view(uid)?.revision())
    }

    fn read(
        &self,
        uid: Uid,
        after: Option<u64>,
        max_bytes: usize,
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
        for record in index.records_after(after) {
            bytes += record.effects().bytes();
            if records.is_empty() || bytes <= max_bytes {
                records.push(record);
            }
        }
        Ok(records)
    }
}

impl FaultLog {
    /// The synced records after `after`; an error if the log was reopened.
    fn synced_after(
        &self,
        uid: Uid,
        after: u64,
        opened: u64,
    ) -> Result<Vec<Arc<Record>>, LogError> {
        let mut journal = self.0.lock();
        if journal.opened != opened {
            return Err(LogError::Closed);
        }
        let head = journal.index(uid)?.head;
        journal.sync(uid, head)?;
        let index = journal.index(uid)?;
        let unapplied = index
            .unapplied
            .iter()
            .map(|(record, ..)| Arc::clone(record));
        let unapplied = unapplied.filter(|record| record.revision() > after);
        let unapplied: Vec<_> = unapplied.collect();
        // Records that were trimmed before they were applied are followed too.
        let first = unapplied.first().map(|first| first.revision());
        if first == Some(after + 1) {
            return Ok(unapplied);
        }
        let oldest = index.head - index.records.len() as u64;
        match after < oldest {
            true => Err(LogError::Trimmed { uid, after, oldest }),
            false => Ok(index.records_after(after)),
        }
    }
}

impl PointStore for FaultLog {
    fn apply(&self, uid: Uid, records: &[Arc<Record>]) -> Result<Arc<dyn View>, LogError> {
        let mut journal = self.0.lock();
        journal.index(uid)?;
        let last = records.last().unwrap();
        let index = journal.indexes.get_mut(&uid).unwrap();
        while let Some((record, sum)) = index.unapplied.pop_front() {
            if record.revision() == last.revision() {
                return Ok(Arc::new(self.view_of(&journal, &record, sum)));
            }
            if record.revision() > last.revision() {
                index.unapplied.push_front((record, sum));
                break;
            }
        }
        for record in records {
            let index = journal.index(uid)?;
            if record.revision() <= index.head {
                continue;
            }
            if record.revision() != index.head + 1 || *record.previous() != index.digest {
                let what = "it does not follow the record before it";
                return Err(LogError::journal_damaged(uid, record.revision(), what));
            }
            journal.write(Item::Append(uid, Arc::clone(record)))?;
        }
        let index = journal.index(uid)?;
        if index.head != last.revision() {
            return Err(LogError::fenced(uid, last.revision(), index.head));
        }
        let view = self.view_of(&journal, last, Arc::clone(&index.sum));
        drop(journal);
        self.2.send_replace(());
        Ok(Arc::new(view))
    }

    fn view(&self, uid: Uid) -> Result<Arc<dyn View>, LogError> {
        let journal = self.0.lock();
        let index = journal.index(uid)?;
        Ok(Arc::new(PinnedView {
            log: self.clone(),
            opened: journal.opened,
            position: RecordPosition {
                revision: index.head,
                digest: index.digest,
            },
            sum: Arc::clone(&index.sum),
        }))
    }

    fn trim(&self, uid: Uid, retention: &Retention) -> Result<(), LogError> {
        let mut journal = self.0.lock();
        let (records, operations) = journal.index(uid)?.outdated(retention);
        match records + operations {
            0 => Ok(()),
            _ => journal.write(Item::Trim(uid, records, operations)),
        }
    }

    fn window(&self, uid: Uid) -> Result<Window, LogError> {
        let journal = self.0.lock();
        let records = &journal.index(uid)?.records;
        let bytes = records.iter().map(|record| record.effects().bytes() as u64);
        Ok(Window {
            records: records.len() as u64,
            bytes: bytes.sum(),
        })
    }

    fn operations(&self, uid: Uid) -> Result<Vec<Arc<Operation>>, LogError> {
        let journal = self.0.lock();
        Ok(journal.index(uid)?.operations.iter().cloned().collect())
    }

    fn restore(
        &self,
        entry: Entry,
        origin: Origin,
        replaces: bool,
    ) -> Result<Box<dyn PointWriter>, LogError> {
        if replaces {
            self.0.lock().index(entry.uid)?;
        }
        Ok(Box::new(StagedIndex {
            log: self.clone(),
            entry,
            origin,
            points: BTreeMap::new(),
            replaces,
        }))
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

impl Catalogue for FaultLog {
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
            .create(entry, Origin::START, Sum::default(), vec![])
    }

    fn delete(&self, uid: Uid) -> Result<(), LogError> {
        let mut journal = self.0.lock();
        journal.index(uid)?;
        journal.write_and_sync(Item::Delete(uid))?;
        drop(journal);
        self.2.send_replace(());
        Ok(())
    }
}

/// A restored index that no reader sees before it is finished. Each addition is a writing call of its own.
struct StagedIndex {
    log: FaultLog,
    entry: Entry,
    origin: Origin,
    points: BTreeMap<u64, Arc<StoredPoint>>,
    /// True if it takes the place of the index with its uid.
    replaces: bool,
}

impl PointWriter for StagedIndex {
    fn add(&mut self, points: &[StoredPoint]) -> Result<(), LogError> {
        self.log.0.lock().called()?;
        let points = points
            .iter()
            .map(|point| (point.id, Arc::new(point.clone())));
        self.points.extend(points);
        Ok(())
    }

    fn finish(
        self: Box<Self>,
        sessions: Sessions,
        operations: Vec<Arc<Operation>>,
    ) -> Result<(), LogError> {
        let (uid, origin) = (self.entry.uid, self.origin);
        let sum = Sum {
            next_id: self.origin.next_id,
            points: self.points,
            sessions,
        };
        let mut journal = self.log.0.lock();
        if !self.replaces {
            return journal.create(self.entry, origin, sum, operations);
        }
        let index = journal.index(uid)?;
        let head = index.head;
        let is_head = (origin.revision, &origin.digest) == (head, &index.digest);
        if origin.revision <= head && !is_head {
            return Err(LogError::fenced(uid, origin.revision, head));
        }
        let item = Item::Create(self.entry, origin, Arc::new(sum), operations);
        journal.write_and_sync(item)?;
        drop(journal);
        self.log.2.send_replace(());
        Ok(())
    }
}
