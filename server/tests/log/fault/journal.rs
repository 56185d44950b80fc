//! The journal, and the state that its items produce.

use std::{
    collections::{BTreeMap, VecDeque},
    sync::Arc,
    time::{Duration, SystemTime},
};

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use wayfold_server::log::{
    Batch, Block, Entry, LogError, Operation, Origin, Record, Retention, Session, Sessions,
    StoredPoint, Uid,
};

/// One write to the journal.
pub(super) enum Item {
    /// An index with the operations that it remembers. It takes the place of one with its uid.
    Create(Entry, Origin, Arc<Sum>, Vec<Arc<Operation>>),
    Append(Uid, Arc<Record>),
    /// Forgets this many of the oldest records and operations.
    Trim(Uid, usize, usize),
    Delete(Uid),
    /// An item of which only half was written.
    Torn,
}

/// The sum of the records.
#[derive(Clone, Default)]
pub(super) struct Sum {
    pub(super) next_id: u64,
    pub(super) points: BTreeMap<u64, Arc<StoredPoint>>,
    pub(super) sessions: Sessions,
}

pub(super) struct Journal {
    pub(super) items: Vec<Item>,
    /// The number of items that are certainly on disk.
    pub(super) synced: usize,
    /// The state after the items, without those of failed calls.
    pub(super) indexes: BTreeMap<Uid, Index>,
    /// The number of writing calls before the one that fails; 0 means the next.
    pub(super) fails: Option<u64>,
    pub(super) failed: Option<LogError>,
    /// The number of times it was opened.
    pub(super) opened: u64,
    pub(super) random: ChaCha8Rng,
}

pub(super) struct Index {
    pub(super) entry: Entry,
    pub(super) head: u64,
    /// The newest revision that is certainly on disk.
    durable: u64,
    pub(super) digest: [u8; 32],
    pub(super) sum: Arc<Sum>,
    pub(super) records: VecDeque<Arc<Record>>,
    pub(super) operations: VecDeque<Arc<Operation>>,
    /// The records that were submitted and not yet applied, oldest first, with the sum after each.
    pub(super) unapplied: VecDeque<(Arc<Record>, Arc<Sum>)>,
}

impl Journal {
    pub(super) fn new(seed: u64) -> Self {
        Self {
            items: Vec::new(),
            synced: 0,
            indexes: BTreeMap::new(),
            fails: None,
            failed: None,
            opened: 0,
            random: ChaCha8Rng::seed_from_u64(seed),
        }
    }

    /// Opens the remaining journal, up to the first half item.
    pub(super) fn open(&mut self, left: usize) {
        let whole = |item: &Item| !matches!(item, Item::Torn);
        let left = self.items[..left]
            .iter()
            .take_while(|item| whole(item))
            .count();
        self.items.truncate(left);
        self.indexes.clear();
        for item in std::mem::take(&mut self.items) {
            self.apply(&item);
            self.items.push(item);
        }
        self.all_synced();
        self.fails = None;
        self.failed = None;
        self.opened += 1;
    }

    /// Counts a writing call; fails if the call must not go on.
    pub(super) fn called(&mut self) -> Result<(), LogError> {
        if let Some(why) = &self.failed {
            return Err(why.clone());
        }
        match self.fails {
            Some(0) => {
                self.fails = None;
                let what = "it was told to fail".into();
                let why = LogError::Storage { what };
                self.failed = Some(why.clone());
                Err(why)
            }
            fails => {
                self.fails = fails.map(|calls| calls - 1);
                Ok(())
            }
        }
    }

    /// Writes an item and makes it visible; after a failure the item is invisible, even if it is on the disk.
    pub(super) fn write(&mut self, item: Item) -> Result<(), LogError> {
        let healthy = self.failed.is_none();
        if let Err(why) = self.called() {
            if healthy {
                match self.random.random_range(0..3) {
                    0 => {}
                    1 => self.items.push(Item::Torn),
                    _ => self.items.push(item),
                }
            }
            return Err(why);
        }
        self.apply(&item);
        self.items.push(item);
        Ok(())
    }

    /// Writes an item like [`Journal::write`], and syncs it.
    pub(super) fn write_and_sync(&mut self, item: Item) -> Result<(), LogError> {
        self.write(item)?;
        self.all_synced();
        Ok(())
    }

    /// Syncs everything, unless the revision is already on disk; returns the newest durable revision.
    pub(super) fn sync(&mut self, uid: Uid, revision: u64) -> Result<u64, LogError> {
        if self.index(uid)?.durable < revision {
            self.called()?;
            self.all_synced();
        }
        Ok(self.index(uid)?.durable)
    }

    fn all_synced(&mut self) {
        self.synced = self.items.len();
        for index in self.indexes.values_mut() {
            index.durable = index.head;
        }
    }

    fn apply(&mut self, item: &Item) {
        match item {
            Item::Create(entry, origin, sum, operations) => {
                let index = Index {
                    entry: entry.clone(),
                    head: origin.revision,
                    durable: origin.revision,
                    digest: origin.digest,
                    sum: Arc::clone(sum),
                    records: VecDeque::new(),
                    operations: operations.iter().cloned().collect(),
                    unapplied: VecDeque::new(),
                };
                self.indexes.insert(entry.uid, index);
            }
            Item::Append(uid, record) => {
                if let Some(index) = self.indexes.get_mut(uid) {
                    index.apply(record);
                }
            }
            Item::Trim(uid, records, operations) => {
                if let Some(index) = self.indexes.get_mut(uid) {
                    index.records.drain(..records);
                    index.operations.drain(..operations);
                }
            }
            Item::Delete(uid) => {
                self.indexes.remove(uid);
            }
            Item::Torn => {}
        }
    }

    pub(super) fn index(&self, uid: Uid) -> Result<&Index, LogError> {
        self.indexes.get(&uid).ok_or(LogError::UnknownIndex { uid })
    }

    pub(super) fn create(
        &mut self,
        entry: Entry,
        origin: Origin,
        sum: Sum,
        operations: Vec<Arc<Operation>>,
    ) -> Result<(), LogError> {
        if self.indexes.contains_key(&entry.uid) {
            return Err(LogError::UidTaken { uid: entry.uid });
        }
        self.write_and_sync(Item::Create(entry, origin, Arc::new(sum), operations))
    }
}

impl Index {
    /// The records after `after` that the index holds.
    pub(super) fn records_after(&self, after: u64) -> Vec<Arc<Record>> {
        let records = self.records.iter();
        let later = records.filter(|record| record.revision() > after);
        later.cloned().collect()
    }

    fn apply(&mut self, record: &Arc<Record>) {
        let effects = record.effects();
        let sum = Arc::make_mut(&mut self.sum);
        for id in effects.removed() {
            sum.points.remove(id);
        }
        for (slot, point) in effects.stored().iter().enumerate() {
            let stored = StoredPoint {
                id: point.id,
                revision: point.revision,
                modified: record.revision(),
                tag: point.tag,
                state: point.row.into(),
                payload: effects.payload(slot),
            };
            sum.next_id = sum.next_id.max(point.id + 1);
            sum.points.insert(point.id, Arc::new(stored));
        }
        if let Some(batch) = effects.batch() {
            sum.next_id = sum.next_id.max(batch.reserved.end);
            sum.sessions = sessions_after(&sum.sessions, batch, record.time_ms());
        }
        self.head = record.revision();
        self.digest = *record.digest();
        self.operations.extend(effects.operation().cloned());
        self.records.push_back(Arc::clone(record));
    }

    /// The numbers of the oldest records and operations that need not be kept.
    pub(super) fn outdated(&self, retention: &Retention) -> (usize, usize) {
        let time =
            |record: &Record| SystemTime::UNIX_EPOCH + Duration::from_millis(record.time_ms());
        let bytes = self.records.iter().map(|record| record.effects().bytes());
        let mut bytes: usize = bytes.sum();
        let mut records = 0;
        while records + 1 < self.records.len()
            && (bytes > retention.record_bytes || time(&self.records[records]) < retention.since)
        {
            bytes -= self.records[records].effects().bytes();
            records += 1;
        }
        let mut bytes: usize = self
            .operations
            .iter()
            .map(|operation| operation.bytes())
            .sum();
        let mut operations = 0;
        while operations + 1 < self.operations.len()
            && (bytes > retention.operation_bytes
                || self.operations.len() - operations > retention.operations)
        {
            bytes -= self.operations[operations].bytes();
            operations += 1;
        }
        (records, operations)
    }
}

/// Builds the sessions anew: it adds those of a batch and leaves out those that the batch ends.
fn sessions_after(before: &Sessions, batch: &Batch, used_ms: u64) -> Sessions {
    let mut after = Sessions::default();
    let is_open = |session: u64| !batch.ended.contains(&session);
    for (id, session) in before.iter().filter(|(id, _)| is_open(*id)) {
        after.insert(id, (**session).clone());
    }
    for (first, block) in before.blocks().filter(|(_, block)| is_open(block.session)) {
        after.insert_block(first, block);
    }
    let session = Session {
        batch: batch.number,
        fingerprint: batch.fingerprint,
        response: batch.response.clone(),
        used_ms,
    };
    after.insert(batch.session, session);
    if !batch.reserved.is_empty() {
        let block = Block {
            end: batch.reserved.end,
            session: batch.session,
        };
        after.insert_block(batch.reserved.start, block);
    }
    after
}
