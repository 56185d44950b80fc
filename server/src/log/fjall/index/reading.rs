//! The reads of an index: its records, its operations and its points.

use std::sync::Arc;

use fjall::Readable;
use tracing::error;

use super::{Head, Index};
use crate::log::{
    LogError, Operation, PointVisitor, Record, View,
    fjall::{
        layout::{Sum, last_of, operation_key, point_keys, record_key, unseal},
        point, session,
        store::{Handles, Store, unreadable},
    },
    retention::Allowance,
};

impl Index {
    /// The submitted records after `after` up to `last`; None if the first of them is already applied.
    pub(in crate::log::fjall) fn unapplied(
        &self,
        after: u64,
        last: u64,
    ) -> Option<Vec<Arc<Record>>> {
        self.unapplied.lock().between(after, last)
    }

    pub(in crate::log::fjall) fn read(
        &self,
        store: &Store,
        after: Option<u64>,
        max_bytes: usize,
    ) -> Result<Vec<Arc<Record>>, LogError> {
        let state = self.lock_open()?;
        let (oldest, head) = (state.head.trimmed, state.head.revision);
        let handles = store.handles()?;
        let snapshot = handles.database.snapshot();
        drop(state);
        let after = after.unwrap_or(oldest);
        if after < oldest {
            let uid = self.entry.uid;
            return Err(LogError::trimmed(uid, after, oldest));
        }
        let mut left = Allowance::of(max_bytes);
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

    /// Decodes the record of a stored value.
    pub(in crate::log::fjall) fn record(
        &self,
        revision: u64,
        value: Option<&[u8]>,
    ) -> Result<Record, LogError> {
        let damaged = |what| LogError::damaged_record(self.entry.uid, revision, what);
        let record = Record::decode(value.ok_or_else(|| damaged("it is missing"))?);
        let record = record.map_err(damaged)?;
        if record.revision() != revision {
            return Err(damaged("it is of another revision"));
        }
        Ok(record)
    }

    /// The stored operations, by revision.
    pub(in crate::log::fjall) fn stored_operations(
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
            let operation = operation.ok_or_else(|| {
                let what = "its operation does not match its checksum";
                LogError::damaged_record(uid, revision, what)
            })?;
            Ok((revision, Arc::new(operation)))
        });
        operations.collect()
    }

    pub(in crate::log::fjall) fn operations(
        &self,
        store: &Store,
    ) -> Result<Vec<Arc<Operation>>, LogError> {
        // The lock prevents appends and trims meanwhile.
        let state = self.lock_open()?;
        let stored = self.stored_operations(&*store.handles()?)?;
        let held = stored
            .into_iter()
            .filter(|(revision, _)| !state.forgotten.contains(revision));
        Ok(held.map(|(_, operation)| operation).collect())
    }

    pub(in crate::log::fjall) fn pin(&self, store: &Arc<Store>) -> Result<Arc<dyn View>, LogError> {
        let mut state = self.lock_open()?;
        if state.is_checked {
            return Ok(self.view_of_head(store, &mut state));
        }
        drop(state);
        self.load(store, &mut |_| Ok(()))
    }

    /// Passes all points to `visit`. The first time after a start they are also compared with their sum: fjall skips an
    /// unreadable part of its journal without an error, and that part may have held points that no other check covers.
    pub(in crate::log::fjall) fn load(
        &self,
        store: &Arc<Store>,
        visit: &mut PointVisitor<'_>,
    ) -> Result<Arc<dyn View>, LogError> {
        let mut state = self.lock_open()?;
        match self.read_all(&*store.handles()?, &state.head, visit) {
            Ok(()) => {
                state.is_checked = true;
                Ok(self.view_of_head(store, &mut state))
            }
            Err(why @ (LogError::Unreadable { .. } | LogError::Damaged { .. })) => {
                drop(state);
                error!(index = self.entry.name, error = %why, "an index is damaged: every call for it fails");
                self.close(why.clone());
                Err(why)
            }
            Err(why) => Err(why),
        }
    }

    fn read_all(
        &self,
        handles: &Handles,
        head: &Head,
        visit: &mut PointVisitor<'_>,
    ) -> Result<(), LogError> {
        let (number, uid) = (self.number, self.entry.uid);
        let mut sum = Sum::default();
        session::sum_up(handles, number, uid, &mut sum)?;
        for point in handles.keyspace.range(point_keys(number)) {
            let (key, value) = point.into_inner().map_err(|error| unreadable(uid, error))?;
            sum.add(&value);
            visit(&point::read_entry(number, uid, (&key, &value))?)?;
        }
        match sum == head.sum {
            true => Ok(()),
            false => Err(LogError::Damaged {
                uid,
                seen: head.revision,
                what: format!(
                    "points are missing, or are not those of revision {}",
                    head.revision
                ),
            }),
        }
    }
}
