//! The writes to an index: records and the points that they change, in one batch.

use std::sync::Arc;

use fjall::OwnedWriteBatch;

use super::{Index, State};
use crate::log::{
    LogError, Outcome, Record, View,
    fjall::{
        layout::{Sum, head_key, operation_key, point_key, record_key, seal},
        point, session,
        store::{Handles, Store, unreadable},
        sync_marks::Mark,
    },
    record::position_after,
};

impl Index {
    /// Writes a record if it follows the head. Calls `written` with the new mark before another record can be written.
    pub(in crate::log::fjall) fn submit(
        &self,
        store: &Arc<Store>,
        record: Arc<Record>,
        written: impl FnOnce(Mark),
    ) -> Result<(), LogError> {
        let mut state = self.lock_open()?;
        if !record.follows(state.head.position()) {
            let (expected, head) = (record.revision() - 1, state.head.revision);
            return Err(LogError::fenced(self.entry.uid, expected, head));
        }
        let handles = store.handles()?;
        self.write(&handles, &mut state, std::slice::from_ref(&record))?;
        let view = self.view_of_head(store, &mut state);
        self.unapplied.lock().push(record, view);
        written(self.mark_of(&state.head));
        Ok(())
    }

    /// Applies consecutive records. The store may already have the first ones. Returns the points as of the last
    /// record. Calls `written` with the new mark if anything was written.
    pub(in crate::log::fjall) fn apply(
        &self,
        store: &Arc<Store>,
        records: &[Arc<Record>],
        written: impl FnOnce(Mark),
    ) -> Result<Arc<dyn View>, LogError> {
        if let Some(view) = self.unapplied.lock().apply(records) {
            return Ok(view);
        }
        let mut state = self.lock_open()?;
        let handles = store.handles()?;
        let before = state.head.revision;
        let known = records.partition_point(|record| record.revision() <= before);
        position_after(self.entry.uid, state.head.position(), &records[known..])?;
        for records in records[known..].chunk_by(|one, next| is_plain(one) && is_plain(next)) {
            self.write(&handles, &mut state, records)?;
        }
        if state.head.revision > before {
            written(self.mark_of(&state.head));
        }
        let head = state.head.revision;
        match records.last().map(|record| record.revision()) {
            Some(last) if last != head => Err(LogError::fenced(self.entry.uid, last, head)),
            _ => Ok(self.view_of_head(store, &mut state)),
        }
    }

    /// Writes the records after the head, and their points, in one batch. Several records must be plain ones.
    fn write(
        &self,
        handles: &Handles,
        state: &mut State,
        records: &[Arc<Record>],
    ) -> Result<(), LogError> {
        let Handles {
            database, keyspace, ..
        } = handles;
        let mut batch = database.batch();
        let mut head = state.head;
        let mut changes = Vec::new();
        for record in records {
            self.put(handles, &mut batch, record, &mut head.sum)?;
            changes = state.sessions.changes(record);
            for change in &changes {
                session::put(change, self.number, &mut batch, keyspace, &mut head.sum);
            }
            head.revision = record.revision();
            head.next_id = head.next_id.max(record.effects().next_id());
            head.digest = *record.digest();
        }
        for trimmed in state.removed + 1..=head.trimmed {
            batch.remove(keyspace, record_key(self.number, trimmed));
        }
        for &forgotten in &state.forgotten {
            batch.remove(keyspace, operation_key(self.number, forgotten));
        }
        batch.insert(keyspace, head_key(self.number), head.encode(self.number));
        if let Some(view) = std::mem::take(&mut state.view).upgrade() {
            view.freeze(handles);
        }
        handles.commit(batch)?;
        state.removed = head.trimmed;
        state.forgotten.clear();
        state.sessions.apply_changes(changes);
        for record in records {
            state.count_arrival(record);
            if let Some(operation) = record.effects().operation() {
                state.count_operation(record.revision(), operation);
            }
        }
        state.head = head;
        Ok(())
    }

    /// Adds a record and its effects to a batch, and to the sum of the points.
    fn put(
        &self,
        handles: &Handles,
        batch: &mut OwnedWriteBatch,
        record: &Record,
        sum: &mut Sum,
    ) -> Result<(), LogError> {
        let effects = record.effects();
        let keyspace = &handles.keyspace;
        let mut forget = |id| {
            let old = keyspace.get(point_key(self.number, id));
            let old = old.map_err(|error| unreadable(self.entry.uid, error))?;
            old.iter().for_each(|old| sum.subtract(old));
            Ok::<_, LogError>(())
        };
        for &id in effects.removed() {
            forget(id)?;
            batch.remove(keyspace, point_key(self.number, id));
        }
        for (point, outcome) in effects.stored().iter().zip(effects.outcomes()) {
            // Most points are new, and under a new id there is no stored point to look up.
            if *outcome != Outcome::Inserted {
                forget(point.id)?;
            }
        }
        for (slot, point) in effects.stored().iter().enumerate() {
            let payload = effects
                .payloads
                .get(slot)
                .map_or(&[][..], |payload| payload);
            let value = point::encode(self.number, point, record.revision(), payload);
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
        Ok(())
    }
}

/// True for a record that only adds points: it does not read what the records before it have written, and writes under
/// keys of its own.
fn is_plain(record: &Arc<Record>) -> bool {
    let effects = record.effects();
    effects.only_adds() && effects.batch().is_none()
}
