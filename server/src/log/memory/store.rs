//! One index in memory: its window of records, and the points that result from all its records.

use std::{
    future::{pending, ready},
    sync::Arc,
};

use imbl::OrdMap;
use parking_lot::Mutex;
use tokio::sync::watch;

use super::view::Head;
use crate::log::{
    LogError, Operation, Origin, Record, RecordPosition, RecordStream, Retention, Sessions,
    StoredPoint, Uid, View, Window, following,
    record::position_after,
    retention::{Allowance, BoundedQueue, arrival_ms},
    unapplied::UnappliedQueue,
};

pub(super) struct Store {
    uid: Uid,
    state: Mutex<State>,
    /// The newest revision, or the error after which no further record comes.
    newest: watch::Sender<Result<u64, LogError>>,
}

struct State {
    head: Head,
    /// The newest records, without a gap up to the head, each with the time from which it counts.
    records: BoundedQueue<(Arc<Record>, u64)>,
    /// The newest operations.
    operations: BoundedQueue<Arc<Operation>>,
    unapplied: UnappliedQueue<Head>,
    /// True if another store has taken the place of this one.
    is_replaced: bool,
}

impl State {
    /// Writes the record after the head.
    fn write(&mut self, record: &Arc<Record>) {
        self.head.apply(record);
        let bytes = record.effects().bytes();
        self.records
            .push((Arc::clone(record), arrival_ms(record)), bytes);
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
            state: Mutex::new(State {
                head: Head {
                    position: origin.position(),
                    next_id: origin.next_id,
                    sessions,
                    points,
                },
                records: BoundedQueue::default(),
                operations: BoundedQueue::default(),
                unapplied: UnappliedQueue::default(),
                is_replaced: false,
            }),
            newest: watch::Sender::new(Ok(origin.revision)),
        }
    }

    pub(super) fn submit(&self, record: Arc<Record>) -> Result<(), LogError> {
        let mut state = self.state.lock();
        if state.is_replaced {
            return Err(LogError::Closed);
        }
        if !record.follows(state.head.position) {
            return Err(self.fenced(record.revision() - 1, &state));
        }
        state.write(&record);
        let head = state.head.clone();
        let revision = record.revision();
        state.unapplied.push(record, head);
        drop(state);
        following::announce(&self.newest, revision);
        Ok(())
    }

    /// Applies consecutive records. The store may already have the first ones. Returns the points as of the last
    /// record.
    pub(super) fn apply(&self, records: &[Arc<Record>]) -> Result<Arc<dyn View>, LogError> {
        let mut state = self.state.lock();
        if state.is_replaced {
            return Err(LogError::Closed);
        }
        let Some(last) = records.last() else {
            return Ok(Arc::new(state.head.clone()));
        };
        if let Some(head) = state.unapplied.apply(records) {
            return Ok(Arc::new(head));
        }
        let position = state.head.position;
        let known = records.partition_point(|record| record.revision() <= position.revision);
        position_after(self.uid, position, &records[known..])?;
        for record in &records[known..] {
            state.write(record);
        }
        if state.head.position.revision != last.revision() {
            return Err(self.fenced(last.revision(), &state));
        }
        let head = state.head.clone();
        drop(state);
        following::announce(&self.newest, last.revision());
        Ok(Arc::new(head))
    }

    fn fenced(&self, expected: u64, state: &State) -> LogError {
        LogError::fenced(self.uid, expected, state.head.position.revision)
    }

    /// Adds operations of records before the first one, oldest first.
    pub(super) fn remember(&self, operations: Vec<Arc<Operation>>) {
        let mut state = self.state.lock();
        for operation in operations {
            let bytes = operation.bytes();
            state.operations.push(operation, bytes);
        }
    }

    /// Takes no record any more, because a copy at the record `copied` takes its place. It is refused unless that is the
    /// newest record or a later one.
    pub(super) fn supersede(&self, copied: RecordPosition) -> Result<(), LogError> {
        let mut state = self.state.lock();
        let head = state.head.position;
        if copied != head && copied.revision <= head.revision {
            return Err(self.fenced(copied.revision, &state));
        }
        state.is_replaced = true;
        drop(state);
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
        following::follow(newest, pending(), after, move |after, newest| {
            ready(self.read_next(after, newest))
        })
    }

    /// The records after the revision `after`. Records that were trimmed before they were applied are followed too.
    fn read_next(&self, after: u64, newest: u64) -> Result<Vec<Arc<Record>>, LogError> {
        let unapplied = self.state.lock().unapplied.between(after, newest);
        unapplied.map_or_else(|| self.read(Some(after), usize::MAX), Ok)
    }

    pub(super) fn read(
        &self,
        after: Option<u64>,
        max_bytes: usize,
    ) -> Result<Vec<Arc<Record>>, LogError> {
        let state = self.state.lock();
        let oldest = state.head.position.revision - state.records.iter().len() as u64;
        let after = after.unwrap_or(oldest);
        if after < oldest {
            return Err(LogError::trimmed(self.uid, after, oldest));
        }
        let skipped = (after - oldest) as usize;
        let mut left = Allowance::of(max_bytes);
        let records = state.records.iter().skip(skipped);
        Ok(records
            .map(|(record, _)| record)
            .take_while(|record| left.take(record))
            .cloned()
            .collect())
    }

    pub(super) fn operations(&self) -> Vec<Arc<Operation>> {
        self.state.lock().operations.iter().cloned().collect()
    }

    pub(super) fn window(&self) -> Window {
        self.state.lock().records.window()
    }

    pub(super) fn trim(&self, retention: &Retention) {
        let state = &mut *self.state.lock();
        retention
            .forget_records(&mut state.records, |(_, time)| *time)
            .for_each(drop);
        retention
            .forget_operations(&mut state.operations)
            .for_each(drop);
    }

    pub(super) fn view(&self) -> Arc<dyn View> {
        Arc::new(self.state.lock().head.clone())
    }
}
