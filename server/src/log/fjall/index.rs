//! One index of the store: where its log is, and how a record gets there.

use std::{collections::VecDeque, sync::Arc};

use fjall::{OwnedWriteBatch, Readable};
use parking_lot::{Mutex, MutexGuard};

use super::{
    layout::{Head, Number, head_key, point_key, record_key},
    marks::Mark,
    point::PointForm,
    store::{Store, storage},
    view::Pinned,
};
use crate::log::{Effects, Entry, LogError, Record, View};

/// See the module.
pub(super) struct Index {
    pub(super) entry: Entry,
    pub(super) number: Number,
    /// Who holds it may write, and sees the store at this very head.
    state: Mutex<State>,
}

pub(super) struct State {
    pub(super) head: Head,
    /// How many bytes the records after `head.trimmed` are counted with, the oldest first.
    window: VecDeque<usize>,
    window_bytes: usize,
    /// The records up to this revision are not even in the store.
    pub(super) removed: u64,
    /// Why it is not to be read or written.
    pub(super) closed: Option<LogError>,
}

impl State {
    /// Takes note of a record that is in the store.
    pub(super) fn held(&mut self, record: &Record) {
        let bytes = record.effects().bytes();
        self.window_bytes += bytes;
        self.window.push_back(bytes);
    }

    /// Of an index without records.
    pub(super) fn empty() -> Self {
        Self {
            head: Head {
                revision: 0,
                next_id: 0,
                trimmed: 0,
                digest: Record::NO_PREVIOUS,
            },
            window: VecDeque::new(),
            window_bytes: 0,
            removed: 0,
            closed: None,
        }
    }
}

impl Index {
    pub(super) fn new(number: Number, entry: Entry, state: State) -> Arc<Self> {
        Arc::new(Self {
            entry,
            number,
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

    /// Takes the state that was found in the store.
    pub(super) fn restore(&self, state: State) {
        *self.state.lock() = state;
    }

    /// Where it is, if it may be used.
    pub(super) fn mark(&self) -> Option<Mark> {
        let state = self.open().ok()?;
        Some(Mark {
            uid: self.entry.uid,
            revision: state.head.revision,
            digest: state.head.digest,
        })
    }

    /// Ends it, and says where it is.
    pub(super) fn close(&self, why: LogError) -> Mark {
        let mut state = self.state.lock();
        state.closed = Some(why);
        Mark {
            uid: self.entry.uid,
            revision: state.head.revision,
            digest: state.head.digest,
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
        let record = Record::new(expected + 1, state.head.digest, effects);
        let highest = record.effects().stored().iter().map(|point| point.id).max();
        let head = Head {
            revision: record.revision(),
            next_id: state.head.next_id.max(highest.map_or(0, |id| id + 1)),
            trimmed: state.head.trimmed,
            digest: *record.digest(),
        };
        let mut batch = store.database.batch();
        self.put(store, &mut batch, &record);
        for trimmed in state.removed + 1..=head.trimmed {
            batch.remove(&store.keyspace, record_key(self.number, trimmed));
        }
        batch.insert(
            &store.keyspace,
            head_key(self.number),
            head.encode(self.number),
        );
        batch.commit().map_err(storage)?;
        state.removed = head.trimmed;
        state.held(&record);
        state.head = head;
        written(Mark {
            uid,
            revision: head.revision,
            digest: head.digest,
        });
        Ok(Arc::new(record))
    }

    fn put(&self, store: &Store, batch: &mut OwnedWriteBatch, record: &Record) {
        let effects = record.effects();
        for &id in effects.removed() {
            batch.remove(&store.keyspace, point_key(self.number, id));
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
            batch.insert(&store.keyspace, point_key(self.number, point.id), value);
        }
        batch.insert(
            &store.keyspace,
            record_key(self.number, record.revision()),
            record.encode(),
        );
    }

    pub(super) fn tail(
        &self,
        store: &Store,
        after: Option<u64>,
    ) -> Result<Vec<Arc<Record>>, LogError> {
        let state = self.open()?;
        let (oldest, head) = (state.head.trimmed, state.head.revision);
        let snapshot = store.database.snapshot();
        drop(state);
        let after = after.unwrap_or(oldest);
        if after < oldest {
            let uid = self.entry.uid;
            return Err(LogError::Trimmed { uid, after, oldest });
        }
        let revisions = after.saturating_add(1)..=head;
        revisions
            .map(|revision| {
                let value = snapshot.get(&store.keyspace, record_key(self.number, revision));
                self.record(revision, value.map_err(storage)?.as_deref())
                    .map(Arc::new)
            })
            .collect()
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

    pub(super) fn pin(&self, store: &Arc<Store>) -> Result<Arc<dyn View>, LogError> {
        let state = self.open()?;
        Ok(Arc::new(Pinned {
            store: Arc::clone(store),
            snapshot: store.database.snapshot(),
            number: self.number,
            uid: self.entry.uid,
            revision: state.head.revision,
            next_id: state.head.next_id,
        }))
    }

    /// Forgets the oldest records. What is forgotten goes out of the store with the next record.
    pub(super) fn trim(&self, keep_bytes: usize) -> Result<(), LogError> {
        let mut state = self.open()?;
        // The newest stays, however large: whoever has all the others must still get it.
        while state.window.len() > 1
            && state.window_bytes > keep_bytes
            && let Some(oldest) = state.window.pop_front()
        {
            state.window_bytes -= oldest;
            state.head.trimmed += 1;
        }
        Ok(())
    }
}
