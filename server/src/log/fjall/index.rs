//! One index of the store: where its log is, and how a record gets there.

use std::{
    collections::VecDeque,
    sync::{
        Arc, OnceLock, Weak,
        atomic::{AtomicU64, Ordering},
    },
    time::SystemTime,
};

use fjall::{OwnedWriteBatch, Readable};
use parking_lot::{Mutex, MutexGuard};

use super::{
    layout::{
        Head, Number, Sum, head_key, last_of, operation_key, point_key, record_key, seal, unseal,
    },
    point::PointForm,
    store::{Handles, Store, storage, unreadable},
    sync_marks::Mark,
    view::PointsView,
};
use crate::log::{
    Effects, Entry, Keep, LogError, Operation, Origin, Record, View,
    record::time_ms,
    window::{Allowance, Window},
};

/// See the module.
pub(super) struct Index {
    pub(super) entry: Entry,
    pub(super) number: Number,
    name: Arc<str>,
    /// The newest revision that is known to be on disk.
    durable: AtomicU64,
    /// Who holds it may write, and sees the store at this very head.
    state: Mutex<State>,
}

pub(super) struct State {
    pub(super) head: Head,
    /// The records after `head.trimmed`, and the operations of `operations`.
    window: Window,
    /// The revisions of the operations that are held, the oldest first.
    operations: VecDeque<u64>,
    /// Operations that are held no longer, and still in the store.
    forgotten: Vec<u64>,
    /// The records up to this revision are not even in the store.
    pub(super) removed: u64,
    /// Why it is not to be read or written.
    closed: Option<LogError>,
    /// The view of the head, while anybody holds it.
    view: Weak<PointsView>,
}

impl State {
    /// Of an index that begins here, with such points.
    pub(super) fn new(origin: Origin, sum: Sum) -> Self {
        Self {
            head: Head::at(&origin, sum),
            window: Window::default(),
            operations: VecDeque::new(),
            forgotten: Vec::new(),
            removed: origin.revision,
            closed: None,
            view: Weak::new(),
        }
    }

    /// Takes note of a record that is in the store.
    pub(super) fn held(&mut self, record: &Record) {
        self.window.hold(record);
    }

    /// Takes note of an operation that is in the store.
    pub(super) fn held_operation(&mut self, revision: u64, operation: &Operation) {
        self.window.hold_operation(operation.bytes());
        self.operations.push_back(revision);
    }
}

impl Index {
    pub(super) fn new(number: Number, entry: Entry, state: State) -> Arc<Self> {
        Arc::new(Self {
            name: entry.name.as_str().into(),
            entry,
            number,
            durable: AtomicU64::new(state.head.revision),
            state: Mutex::new(state),
        })
    }

    /// The state, of an index that may be used.
    fn open(&self) -> Result<MutexGuard<'_, State>, LogError> {
        let state = self.state.lock();
        match &state.closed {
            Some(why) => Err(why.clone()),
            None => Ok(state),
        }
    }

    /// Why it may not be used.
    pub(super) fn closed(&self) -> Option<LogError> {
        self.state.lock().closed.clone()
    }

    /// The newest revision that is known to be on disk.
    pub(super) fn durable(&self) -> u64 {
        self.durable.load(Ordering::Acquire)
    }

    /// Takes note that `revision` is on disk.
    pub(super) fn set_durable(&self, revision: u64) {
        self.durable.fetch_max(revision, Ordering::Release);
    }

    /// Takes the state that was found in the store, where it is made certain before anybody reads it.
    pub(super) fn restore(&self, state: State) {
        self.set_durable(state.head.revision);
        *self.state.lock() = state;
    }

    /// Where it is.
    pub(super) fn here(&self) -> Mark {
        self.mark_of(&self.state.lock().head)
    }

    /// Where it is, if it may be used.
    pub(super) fn mark(&self) -> Option<Mark> {
        Some(self.mark_of(&self.open().ok()?.head))
    }

    /// Ends it, and says where it is.
    pub(super) fn close(&self, why: LogError) -> Mark {
        let mut state = self.state.lock();
        // A deleted index is removed from the store bit by bit.
        if let Some(view) = std::mem::take(&mut state.view).upgrade()
            && let Ok(handles) = view.store.handles()
        {
            view.freeze(&handles);
        }
        state.closed = Some(why);
        self.mark_of(&state.head)
    }

    fn mark_of(&self, head: &Head) -> Mark {
        Mark {
            uid: self.entry.uid,
            name: Arc::clone(&self.name),
            revision: head.revision,
            digest: head.digest,
            deleted: false,
        }
    }

    /// Appends a record; `written` is called with where the index is then, before anybody else can append.
    pub(super) fn append(
        &self,
        store: &Store,
        expected: u64,
        effects: Effects,
        written: impl FnOnce(Mark),
    ) -> Result<Arc<Record>, LogError> {
        let mut state = self.open()?;
        let uid = self.entry.uid;
        if state.head.revision != expected {
            return Err(LogError::Fenced {
                uid,
                expected,
                head: state.head.revision,
            });
        }
        let now = time_ms(SystemTime::now());
        let record = Record::new(expected + 1, state.head.digest, now, effects);
        let highest = record.effects().stored().iter().map(|point| point.id).max();
        let handles = store.handles()?;
        handles.wait_for_room()?;
        let Handles { database, keyspace } = &*handles;
        let mut batch = database.batch();
        let sum = self.put(&handles, &mut batch, &record, &state.head)?;
        let head = Head {
            revision: record.revision(),
            next_id: state.head.next_id.max(highest.map_or(0, |id| id + 1)),
            trimmed: state.head.trimmed,
            digest: *record.digest(),
            sum,
        };
        for trimmed in state.removed + 1..=head.trimmed {
            batch.remove(keyspace, record_key(self.number, trimmed));
        }
        for &forgotten in &state.forgotten {
            batch.remove(keyspace, operation_key(self.number, forgotten));
        }
        batch.insert(keyspace, head_key(self.number), head.encode(self.number));
        if let Some(view) = std::mem::take(&mut state.view).upgrade() {
            view.freeze(&handles);
        }
        batch.commit().map_err(storage)?;
        state.removed = head.trimmed;
        state.forgotten.clear();
        state.held(&record);
        if let Some(operation) = record.effects().operation() {
            state.held_operation(record.revision(), operation);
        }
        state.head = head;
        written(self.mark_of(&head));
        Ok(Arc::new(record))
    }

    /// Puts a record and what it does into a batch; returns the sum of the points as they are then.
    fn put(
        &self,
        handles: &Handles,
        batch: &mut OwnedWriteBatch,
        record: &Record,
        before: &Head,
    ) -> Result<Sum, LogError> {
        let effects = record.effects();
        let keyspace = &handles.keyspace;
        let mut sum = before.sum;
        let mut forget = |id| {
            // Most are new, and then there is nothing to look for.
            if id < before.next_id {
                let old = keyspace.get(point_key(self.number, id));
                let old = old.map_err(|error| unreadable(self.entry.uid, error))?;
                old.iter().for_each(|old| sum.subtract(old));
            }
            Ok::<_, LogError>(())
        };
        for &id in effects.removed() {
            forget(id)?;
            batch.remove(keyspace, point_key(self.number, id));
        }
        for point in effects.stored().iter() {
            forget(point.id)?;
        }
        for (slot, point) in effects.stored().iter().enumerate() {
            let form = PointForm {
                revision: point.revision,
                modified: record.revision(),
                tag: point.tag,
                state: point.row,
                payload: &effects.payload(slot),
            };
            let value = form.encode(self.number, point.id);
            sum.add(&value);
            batch.insert(keyspace, point_key(self.number, point.id), value);
        }
        if let Some(operation) = effects.operation() {
            let key = operation_key(self.number, record.revision());
            batch.insert(keyspace, key, seal(&key, operation.encode()));
        }
        batch.insert(
            keyspace,
            record_key(self.number, record.revision()),
            record.encode(),
        );
        Ok(sum)
    }

    pub(super) fn tail(
        &self,
        store: &Store,
        after: Option<u64>,
        most: usize,
    ) -> Result<Vec<Arc<Record>>, LogError> {
        let state = self.open()?;
        let (oldest, head) = (state.head.trimmed, state.head.revision);
        let handles = store.handles()?;
        let snapshot = handles.database.snapshot();
        drop(state);
        let after = after.unwrap_or(oldest);
        if after < oldest {
            let uid = self.entry.uid;
            return Err(LogError::Trimmed { uid, after, oldest });
        }
        let mut left = Allowance::of(most);
        let mut records = Vec::new();
        for revision in after.saturating_add(1)..=head {
            let value = snapshot.get(&handles.keyspace, record_key(self.number, revision));
            let value = value.map_err(|error| unreadable(self.entry.uid, error))?;
            let record = self.record(revision, value.as_deref())?;
            if !left.take(&record) {
                break;
            }
            records.push(Arc::new(record));
        }
        Ok(records)
    }

    /// The record of a stored value.
    pub(super) fn record(&self, revision: u64, value: Option<&[u8]>) -> Result<Record, LogError> {
        let damaged = |what| LogError::Damaged {
            uid: self.entry.uid,
            revision,
            what,
        };
        let record = Record::decode(value.ok_or_else(|| damaged("it is missing"))?);
        let record = record.map_err(damaged)?;
        if record.revision() != revision {
            return Err(damaged("it is of another revision"));
        }
        Ok(record)
    }

    /// The operations that the store holds, by revision.
    pub(super) fn stored_operations(
        &self,
        handles: &Handles,
    ) -> Result<Vec<(u64, Arc<Operation>)>, LogError> {
        let uid = self.entry.uid;
        let range = operation_key(self.number, 0)..=operation_key(self.number, u64::MAX);
        let operations = handles.keyspace.range(range).map(|operation| {
            let (key, value) = operation
                .into_inner()
                .map_err(|error| unreadable(uid, error))?;
            let revision = last_of(&key).unwrap_or_default();
            let operation = unseal(&key, &value).and_then(Operation::decode);
            let operation = operation.ok_or(LogError::Damaged {
                uid,
                revision,
                what: "its operation does not match its checksum",
            })?;
            Ok((revision, Arc::new(operation)))
        });
        operations.collect()
    }

    pub(super) fn operations(&self, store: &Store) -> Result<Vec<Arc<Operation>>, LogError> {
        // Nobody appends or trims meanwhile.
        let state = self.open()?;
        let stored = self.stored_operations(&*store.handles()?)?;
        let held = stored
            .into_iter()
            .filter(|(revision, _)| !state.forgotten.contains(revision));
        Ok(held.map(|(_, operation)| operation).collect())
    }

    pub(super) fn pin(&self, store: &Arc<Store>) -> Result<Arc<dyn View>, LogError> {
        let mut state = self.open()?;
        if let Some(view) = state.view.upgrade() {
            return Ok(view);
        }
        let view = Arc::new(PointsView {
            store: Arc::clone(store),
            frozen: OnceLock::new(),
            number: self.number,
            uid: self.entry.uid,
            revision: state.head.revision,
            next_id: state.head.next_id,
        });
        state.view = Arc::downgrade(&view);
        Ok(view)
    }

    /// Forgets the oldest records and operations. What is forgotten goes out of the store with the next record.
    pub(super) fn trim(&self, keep: &Keep) -> Result<(), LogError> {
        let mut state = self.open()?;
        let trimmed = state.window.trim(keep);
        state.head.trimmed += trimmed.records as u64;
        let forgotten: Vec<u64> = state.operations.drain(..trimmed.operations).collect();
        state.forgotten.extend(forgotten);
        Ok(())
    }
}
