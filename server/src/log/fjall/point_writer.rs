//! Restores an index into the store, point by point, as a new one or in the place of the one with its uid.
//!
//! Until the last batch, the entry says that the copy is unfinished. If the restore ends earlier, the copy's keys are
//! removed like those of a deleted index. If the entry says unfinished and a mark says finished, the index is lost. The
//! last batch of a copy that takes the place of an index also marks that index as deleted, so a crash leaves one
//! of them.

use std::sync::Arc;

use super::{
    engine::Engine,
    index::{Index, State},
    layout::{
        Head, Number, Stage, StagedEntry, Sum, entry_key, head_key, operation_key, point_key, seal,
    },
    point, session,
};
use crate::log::{Entry, LogError, Operation, Origin, PointWriter, Sessions, StoredPoint};

/// An index that is being restored.
pub(super) struct FjallPointWriter {
    engine: Arc<Engine>,
    number: Number,
    entry: Entry,
    origin: Origin,
    /// The sum of the added points.
    sum: Sum,
    /// True if it takes the place of the index with its uid.
    replaces: bool,
    finished: bool,
}

/// The parts of a copy that are written last.
struct End<'a> {
    sessions: &'a Sessions,
    /// With the revisions under which they are kept.
    operations: &'a [(u64, Arc<Operation>)],
    /// The index whose place the copy takes.
    replaced: Option<&'a Index>,
}

impl FjallPointWriter {
    pub(super) fn begin(
        engine: Arc<Engine>,
        number: Number,
        entry: Entry,
        origin: Origin,
        replaces: bool,
    ) -> Result<Self, LogError> {
        let mut copy = Self {
            engine,
            number,
            entry,
            origin,
            sum: Sum::default(),
            replaces,
            finished: false,
        };
        copy.write(&[], None)?;
        Ok(copy)
    }

    fn write(&mut self, points: &[StoredPoint], end: Option<&End<'_>>) -> Result<(), LogError> {
        let result = self.try_write(points, end);
        result.map_err(|error| self.engine.failure.note(error))
    }

    /// Writes points and the entry in one batch, and what completes the copy if this is its end.
    fn try_write(&mut self, points: &[StoredPoint], end: Option<&End<'_>>) -> Result<(), LogError> {
        let number = self.number;
        let mut sum = self.sum;
        let handles = self.engine.store.handles()?;
        let keyspace = &handles.keyspace;
        let mut batch = handles.database.batch();
        for stored in points {
            let point = stored.indexed();
            let value = point::encode(number, point, stored.modified, &stored.payload);
            sum.add(&value);
            batch.insert(keyspace, point_key(number, point.id), value);
        }
        if let Some(end) = end {
            session::put_all(end.sessions, number, &mut batch, keyspace, &mut sum);
            let head = Head::at(&self.origin, sum);
            batch.insert(keyspace, head_key(number), head.encode(number));
            for (revision, operation) in end.operations {
                let key = operation_key(number, *revision);
                batch.insert(keyspace, key, seal(&key, operation.encode()));
            }
            if let Some(replaced) = end.replaced {
                let staged = StagedEntry {
                    entry: replaced.entry.clone(),
                    stage: Stage::Deleted,
                };
                let key = entry_key(replaced.number);
                batch.insert(keyspace, key, staged.encode(replaced.number));
            }
        }
        let staged = StagedEntry {
            entry: self.entry.clone(),
            stage: match end {
                Some(_) => Stage::Whole,
                None => Stage::Copied,
            },
        };
        batch.insert(keyspace, entry_key(number), staged.encode(number));
        handles.commit(batch)?;
        self.sum = sum;
        Ok(())
    }

    /// Writes the last batch.
    fn complete(
        &mut self,
        sessions: Sessions,
        operations: &[(u64, Arc<Operation>)],
        replaced: Option<&Index>,
    ) -> Result<Arc<Index>, LogError> {
        // From here on the index may exist: if a step fails, the next start decides.
        self.finished = true;
        self.write(
            &[],
            Some(&End {
                sessions: &sessions,
                operations,
                replaced,
            }),
        )?;
        let mut state = State::new(self.origin, self.sum);
        for (revision, operation) in operations {
            state.count_operation(*revision, operation);
        }
        state.sessions = sessions;
        Ok(Index::new(self.number, self.entry.clone(), state))
    }
}

impl PointWriter for FjallPointWriter {
    fn add(&mut self, points: &[StoredPoint]) -> Result<(), LogError> {
        self.write(points, None)
    }

    fn finish(
        mut self: Box<Self>,
        sessions: Sessions,
        operations: Vec<Arc<Operation>>,
    ) -> Result<(), LogError> {
        let origin = self.origin;
        origin.has_room_for(self.entry.uid, operations.len())?;
        // The revisions are the keys of the operations: they must ascend and differ, and mean nothing else.
        let first = origin.revision + 1 - operations.len() as u64;
        let operations: Vec<_> = (first..).zip(operations).collect();
        let engine = Arc::clone(&self.engine);
        if self.replaces {
            let uid = self.entry.uid;
            return engine.swap_in(uid, origin.position(), |old| {
                self.complete(sessions, &operations, Some(old))
            });
        }
        let index = self.complete(sessions, &operations, None)?;
        engine.add(index)
    }
}

impl Drop for FjallPointWriter {
    fn drop(&mut self) {
        if !self.finished {
            self.engine.sweeper.sweep(self.number);
        }
    }
}
