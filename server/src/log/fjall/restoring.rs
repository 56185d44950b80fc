//! Restores an index into the store, point by point.
//!
//! Until the last batch, the entry says that the copy is unfinished. If the restore ends earlier, the copy's keys are
//! removed like those of a deleted index. If the entry says so and a mark says that the copy was finished, the index is
//! lost.

use std::sync::Arc;

use super::{
    engine::Engine,
    index::{Index, State},
    layout::{Head, Named, Number, Stage, Sum, entry_key, head_key, point_key},
    point::PointForm,
    session,
    store::storage,
};
use crate::log::{Entry, LogError, Origin, Restoring, Sessions, StoredPoint};

/// An index that is being restored.
pub(super) struct RestoringIndex {
    engine: Arc<Engine>,
    number: Number,
    entry: Entry,
    origin: Origin,
    /// The sum of the added points.
    sum: Sum,
    finished: bool,
}

impl RestoringIndex {
    /// Begins a restore under a new number.
    pub(super) fn begin(
        engine: Arc<Engine>,
        number: Number,
        entry: Entry,
        origin: Origin,
    ) -> Result<Self, LogError> {
        let mut copy = Self {
            engine,
            number,
            entry,
            origin,
            sum: Sum::default(),
            finished: false,
        };
        copy.write(&[], None)?;
        Ok(copy)
    }

    fn write(
        &mut self,
        points: &[StoredPoint],
        finished: Option<&Sessions>,
    ) -> Result<(), LogError> {
        let result = self.try_write(points, finished);
        result.map_err(|error| self.engine.note(error))
    }

    /// Writes points and the entry in one batch, and the sessions and the head of the index if it is `finished`.
    fn try_write(
        &mut self,
        points: &[StoredPoint],
        finished: Option<&Sessions>,
    ) -> Result<(), LogError> {
        let number = self.number;
        let mut sum = self.sum;
        let handles = self.engine.store.handles()?;
        handles.wait_for_room()?;
        let keyspace = &handles.keyspace;
        let mut batch = handles.database.batch();
        for point in points {
            let form = PointForm {
                revision: point.revision,
                modified: point.modified,
                tag: point.tag,
                state: &point.state,
                payload: &point.payload,
            };
            let value = form.encode(number, point.id);
            sum.add(&value);
            batch.insert(keyspace, point_key(number, point.id), value);
        }
        if let Some(sessions) = finished {
            session::put_all(sessions, number, (&mut batch, keyspace), &mut sum);
            let head = Head::at(&self.origin, sum);
            batch.insert(keyspace, head_key(number), head.encode(number));
        }
        let named = Named {
            entry: self.entry.clone(),
            stage: match finished {
                Some(_) => Stage::Whole,
                None => Stage::Copied,
            },
        };
        batch.insert(keyspace, entry_key(number), named.encode(number));
        batch.commit().map_err(storage)?;
        self.sum = sum;
        Ok(())
    }
}

impl Restoring for RestoringIndex {
    fn add(&mut self, points: &[StoredPoint]) -> Result<(), LogError> {
        self.write(points, None)
    }

    fn finish(mut self: Box<Self>, sessions: Sessions) -> Result<(), LogError> {
        self.write(&[], Some(&sessions))?;
        // From here on the index may exist: if the next step fails, the next start decides.
        self.finished = true;
        let mut state = State::new(self.origin, self.sum);
        state.sessions = sessions;
        let index = Index::new(self.number, self.entry.clone(), state);
        self.engine.add(index)
    }
}

impl Drop for RestoringIndex {
    fn drop(&mut self) {
        if !self.finished {
            self.engine.sweeper.sweep(self.number);
        }
    }
}
