//! The commit of a mutation: it is submitted to the journal, and acknowledged once the apply loop has published it.

use std::sync::{
    Arc,
    atomic::{AtomicU64, Ordering::SeqCst},
};

use tokio::sync::oneshot;

use super::{Hosted, RegistryError, WriteGuard, apply::AwaitedReceipt, in_flight::Decision};
use crate::log::{Effects, LogError, Operation, Receipt, Record, Sessions};

/// A mutation above these sizes, or one that changes existing points or ends sessions, is submitted on a blocking thread.
/// A batch above them, or one that ends sessions, is applied on one; with a shared journal also one that changes existing
/// points, and any while the store is busy. Inline it would delay the calls that share the thread.
pub(super) const MAX_INLINE_POINTS: usize = 1024;
pub(super) const MAX_INLINE_BYTES: usize = 128 * 1024;

/// A remembered operation above this size is growth, even if it changed nothing. Those of removals are far below it: a removal
/// goes on above a watermark.
const MAX_SMALL_OPERATION_BYTES: usize = 1024;

/// Above a watermark sessions open until an index has this many, and take ids until it has this many blocks, so that a shared
/// index can be read, and can remove points. They take 200 KB.
const MAX_FEW_SESSIONS: usize = 256;
const MAX_FEW_BLOCKS: usize = 1024;

/// The number of times that memory and disk have the bytes of a mutation: as a record, as points in the store, and in
/// the forest or in the files that the store writes again.
const STORED_COPIES: u64 = 3;

/// The empty records that calls of [`Hosted::latest`] wait for, counted from 1.
#[derive(Default)]
pub(super) struct LatestReads {
    /// The number of the last that has begun.
    begun: AtomicU64,
    /// The number of the last that is published. Its holder submits the next one.
    done: tokio::sync::Mutex<u64>,
}

/// The outcome of a commit.
#[must_use]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CommitOutcome {
    /// It took effect, is published, and is as durable as configured.
    Done,
    /// Another writer was first, and the mutation had no effect. Evaluate it again.
    Refused,
}

impl Hosted {
    /// Commits a mutation that was evaluated under `writer`: submits the `effects`, and returns once they are
    /// published. Above a watermark a mutation that stores points is refused, and so is one that adds to many sessions or
    /// blocks of ids and removes no point, or remembers more than a small answer. From the first poll on the commit completes,
    /// even if the caller drops the future.
    pub async fn commit(
        self: &Arc<Self>,
        writer: WriteGuard,
        effects: Effects,
    ) -> Result<CommitOutcome, RegistryError> {
        // A record that stores no point may remember a large answer. Sessions and blocks of ids stay for a week, and a start reads
        // all of them.
        let operation = effects.operation().map_or(0, |it| it.bytes());
        if !effects.stored().is_empty()
            || has_many_sessions(writer.sessions(), &effects)
            || operation > MAX_SMALL_OPERATION_BYTES
        {
            self.host
                .watermarks
                .admit(STORED_COPIES * effects.bytes() as u64)?;
        }
        let is_small = effects.len() <= MAX_INLINE_POINTS
            && effects.bytes() <= MAX_INLINE_BYTES
            && !effects.ends_sessions();
        // The log reads a point before it replaces or removes it.
        let submitted = if is_small && effects.only_adds() && !self.host.log.journal.is_busy() {
            self.submit(writer, effects)
        } else {
            let hosted = Arc::clone(self);
            tokio::task::spawn_blocking(move || hosted.submit(writer, effects))
                .await
                .map_err(|_| RegistryError::Stopped)?
        };
        self.submitted_outcome(submitted).await
    }

    /// Fails if the journal never takes the record of these effects.
    pub fn check_size(&self, effects: &Effects) -> Result<(), RegistryError> {
        let checked = self.host.log.journal.check_size(self.uid(), effects);
        checked.map_err(RegistryError::from)
    }

    async fn submitted_outcome(
        &self,
        submitted: Result<oneshot::Receiver<Decision>, RegistryError>,
    ) -> Result<CommitOutcome, RegistryError> {
        match submitted {
            Ok(decision) => {
                let outcome = outcome(decision).await;
                outcome.map_err(|why| why.of_copy(self.is_shared()))
            }
            Err(RegistryError::Log(LogError::Fenced { head, .. })) => {
                // A mutation that is evaluated again before the other writer's records are published would be refused
                // again.
                self.reached(head).await?;
                Ok(CommitOutcome::Refused)
            }
            Err(error) => Err(error),
        }
    }

    /// Waits until the newest record of `writer` is published. A response that was evaluated under `writer` and changes
    /// nothing may be returned then. If other servers share the journal, an empty record shows that none has written
    /// since.
    pub async fn confirm_current(
        &self,
        writer: WriteGuard,
    ) -> Result<CommitOutcome, RegistryError> {
        if self.is_shared() {
            let effects = Effects::new(self.space().coordinates());
            return self.submitted_outcome(self.submit(writer, effects)).await;
        }
        let decision = {
            let mut in_flight = self.in_flight.lock();
            in_flight.wait_for(writer.position(), writer.refusals())
        };
        drop(writer);
        outcome(decision).await
    }

    /// Waits until every mutation that any server acknowledged before the call is published here. Servers that share a
    /// journal may lag behind it, and NATS may be asked at a server that lags itself: only an accepted record shows that
    /// none is missing. All calls that wait share the next one. Returns false, without a record, if `may_write` is false
    /// once this call holds the writer.
    pub async fn latest(
        self: &Arc<Self>,
        may_write: impl Fn() -> bool,
    ) -> Result<bool, RegistryError> {
        if !self.is_shared() {
            return Ok(true);
        }
        let LatestReads { begun, done } = &self.latest_reads;
        let next = begun.load(SeqCst) + 1;
        let mut done = done.lock().await;
        if *done >= next {
            return Ok(true);
        }
        let number = begun.fetch_add(1, SeqCst) + 1;
        loop {
            let writer = self.write().await?;
            if !may_write() {
                return Ok(false);
            }
            if self.confirm_current(writer).await? == CommitOutcome::Done {
                *done = number;
                return Ok(true);
            }
        }
    }

    /// The operation with this id, remembered or pending.
    pub fn recall(&self, writer: &WriteGuard, id: &str) -> Option<Arc<Operation>> {
        let pending = writer.pending_operation(id).cloned();
        pending.or_else(|| self.operations.lock().recall(id).cloned())
    }

    /// Remembers an operation that changed nothing and has no record. Above a watermark it refuses all but those with small
    /// answers.
    pub fn remember(&self, operation: Arc<Operation>) -> Result<(), RegistryError> {
        let bytes = operation.bytes();
        if bytes > MAX_SMALL_OPERATION_BYTES {
            self.host.watermarks.admit(bytes as u64)?;
        }
        self.operations.lock().remember(operation);
        Ok(())
    }

    fn submit(
        &self,
        mut writer: WriteGuard,
        effects: Effects,
    ) -> Result<oneshot::Receiver<Decision>, RegistryError> {
        let previous = writer.position();
        let record = Arc::new(Record::made_by(self.host.run, previous, effects));
        // The record is added before the journal has it: the apply loop may receive it at once.
        let added = {
            let mut in_flight = self.in_flight.lock();
            in_flight.add(record.position(), writer.refusals())
        };
        let decision =
            added.map_err(|head| LogError::fenced(self.uid(), previous.revision, head))?;
        writer.push(Arc::clone(&record));
        match self
            .host
            .log
            .journal
            .submit(self.uid(), Arc::clone(&record))
        {
            Ok(Receipt::Accepted) => {}
            Ok(Receipt::Awaited(outcome)) => self.await_receipt(AwaitedReceipt {
                record,
                base: writer.base().view.position(),
                outcome,
            }),
            Err(error) => {
                self.in_flight.lock().take_back(record.position());
                writer.take_back();
                return Err(error.into());
            }
        }
        Ok(decision)
    }
}

async fn outcome(decision: oneshot::Receiver<Decision>) -> Result<CommitOutcome, RegistryError> {
    match decision.await {
        Ok(Decision::Published) => Ok(CommitOutcome::Done),
        Ok(Decision::Refused) => Ok(CommitOutcome::Refused),
        Ok(Decision::Failed(why)) => Err(why),
        // The sender is dropped unanswered only together with the index.
        Err(_) => Err(RegistryError::Stopped),
    }
}

/// True if the effects add a session or a block of ids where there are many, and remove no point.
fn has_many_sessions(sessions: &Sessions, effects: &Effects) -> bool {
    let Some(batch) = effects.batch().filter(|_| effects.removed().is_empty()) else {
        return false;
    };
    match batch.number {
        0 => sessions.len().saturating_sub(batch.ended.len()) >= MAX_FEW_SESSIONS,
        _ => !batch.reserved.is_empty() && sessions.block_count() >= MAX_FEW_BLOCKS,
    }
}
