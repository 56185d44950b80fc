//! The apply loop of an index: it takes the next records from the journal, its own as soon as the journal has acknowledged
//! them, checks that they follow, applies them to the point store and the forest, and publishes the result. A point of
//! the index changes nowhere else.

use std::{
    panic::AssertUnwindSafe,
    sync::{Arc, Weak, atomic::Ordering::Relaxed},
    time::{Duration, Instant, SystemTime},
};

use futures_util::{
    FutureExt, StreamExt,
    future::BoxFuture,
    stream::{FuturesOrdered, FuturesUnordered},
};
use tokio::{
    sync::{OwnedMutexGuard, mpsc},
    task::yield_now,
};
use tracing::{debug, error, warn};
use wayfold_index::Forest;

use super::{
    Hosted, Published, RegistryError,
    commit::{MAX_INLINE_BYTES, MAX_INLINE_POINTS},
    in_flight::notify,
    stopped::is_damage,
};
use crate::log::{Effects, LogError, Record, RecordPosition, RecordStream, View, position_after};

/// The forest of an index, as of the published revision.
pub(super) struct AppliedForest {
    pub(super) forest: Forest,
    /// The number of tasks that merge this forest's levels.
    pub(super) mergers: usize,
}

/// A receipt for which the loop waits.
pub(super) struct AwaitedReceipt {
    /// The submitted record.
    pub(super) record: Arc<Record>,
    /// The record that was published when it was submitted: the journal had it.
    pub(super) base: RecordPosition,
    pub(super) outcome: BoxFuture<'static, Result<(), LogError>>,
}

/// Runs the apply loop of this number until the index is dropped or its journal fails. A panic closes the index too: nothing
/// would decide its records any more.
pub(super) async fn run(
    hosted: Weak<Hosted>,
    number: u64,
    records: RecordStream,
    receipts: mpsc::UnboundedReceiver<AwaitedReceipt>,
) {
    let applying = apply_all(Weak::clone(&hosted), records, receipts);
    let ended = AssertUnwindSafe(applying).catch_unwind().await;
    // The panic hook has printed the panic.
    let outcome = ended.unwrap_or(Err(RegistryError::Stopped));
    if let Err(error) = outcome
        && let Some(hosted) = hosted.upgrade()
    {
        // The log reports its failure once, so an index logs it at debug level only.
        match is_damage(&error) && !hosted.is_reported.swap(true, Relaxed) {
            true => {
                error!(index = hosted.name(), %error, "no further record is applied");
            }
            false => debug!(index = hosted.name(), %error, "cannot follow the log"),
        }
        hosted.end_loop(number, error);
    }
}

/// Applies the records of the journal until the index is dropped. An error ends it.
async fn apply_all(
    hosted: Weak<Hosted>,
    mut records: RecordStream,
    mut receipts: mpsc::UnboundedReceiver<AwaitedReceipt>,
) -> Result<(), RegistryError> {
    // A receipt counts after those of the records before its own: a lost record is settled before the next one.
    let (mut awaited, mut arrivals) = (FuturesOrdered::new(), FuturesUnordered::new());
    let mut void = None;
    loop {
        let applied = tokio::select! {
            batch = records.next() => {
                let Some(hosted) = hosted.upgrade() else {
                    return Ok(());
                };
                match batch {
                    Some(Ok(records)) => {
                        let applied = hosted.apply(records).await;
                        drop(hosted);
                        // Writers that are ready submit first: one batch of their records costs less than many.
                        yield_now().await;
                        applied
                    }
                    // The stream was behind the acknowledged records, which are applied and may be forgotten.
                    Some(Err(LogError::Trimmed { after, .. }))
                        if after < hosted.published().revision =>
                    {
                        records = hosted.follow();
                        Ok(())
                    }
                    Some(Err(error)) => Err(error.into()),
                    None => Err(RegistryError::Log(LogError::Closed)),
                }
            }
            Some(receipt) = receipts.recv() => {
                let AwaitedReceipt { record, base, outcome } = receipt;
                awaited.push_back(async move { (record, base, outcome.await) });
                Ok(())
            }
            Some(receipt) = awaited.next() => {
                let Some(hosted) = hosted.upgrade() else {
                    return Ok(());
                };
                // The journal has the acknowledged records: they do not wait until it brings them.
                let (mut acknowledged, mut next) = (Vec::new(), Some(receipt));
                while let Some((record, _, Ok(()))) = next {
                    acknowledged.push(record);
                    next = awaited.next().now_or_never().flatten();
                }
                let mut outcome = hosted.apply_acknowledged(acknowledged).await;
                if outcome.is_ok() && let Some((record, base, Err(error))) = next {
                    let arrival = hosted.not_accepted(&record, base, error, &mut void).await;
                    outcome = arrival.map(|arrival| arrivals.push(arrival));
                }
                drop(hosted);
                yield_now().await;
                outcome
            }
            Some(arrived) = arrivals.next() => arrived,
        };
        applied?;
    }
}

impl Hosted {
    /// The records after the published one.
    fn follow(&self) -> RecordStream {
        let published = self.published().view.position();
        let journal = &self.host.log.journal;
        journal.follow_applied(self.uid(), published)
    }

    /// Applies consecutive records that the journal has acknowledged, unless records of others come first: the journal
    /// brings all of them in their order.
    async fn apply_acknowledged(
        self: &Arc<Self>,
        records: Vec<Arc<Record>>,
    ) -> Result<(), RegistryError> {
        let published = self.published().view.position();
        let follows = |record: &Arc<Record>| record.follows(published);
        match records.iter().position(follows) {
            Some(first) => self.apply(records[first..].to_vec()).await,
            None => Ok(()),
        }
    }

    /// Applies consecutive records, and publishes the last revision.
    async fn apply(self: &Arc<Self>, records: Vec<Arc<Record>>) -> Result<(), RegistryError> {
        let applied = Arc::clone(&self.applied).lock_owned().await;
        let sizes = records.iter().map(|record| record.effects());
        let (points, bytes) = sizes.fold((0, 0), |(points, bytes), effects| {
            (points + effects.len(), bytes + effects.bytes())
        });
        let mut all = records.iter().map(|record| record.effects());
        let ends_sessions = all.any(Effects::ends_sessions);
        let may_block = self.is_shared() && self.store_may_block(&records);
        let hosted = Arc::clone(self);
        let applying = move || {
            hosted.apply_now(applied, &records, |records| {
                hosted.host.log.points.apply(hosted.uid(), records)
            })
        };
        let is_small = points <= MAX_INLINE_POINTS && bytes <= MAX_INLINE_BYTES;
        if is_small && !ends_sessions && !may_block {
            return applying();
        }
        let applied = tokio::task::spawn_blocking(applying).await;
        applied.map_err(|error| match error.is_cancelled() {
            // The runtime ends.
            true => RegistryError::Log(LogError::Closed),
            false => RegistryError::Stopped,
        })?
    }

    /// True if the point store may wait for its disk while it writes these records: it may have to catch up, and it reads a
    /// point before it replaces or removes it.
    fn store_may_block(&self, records: &[Arc<Record>]) -> bool {
        // The journal also brings the records that were applied once they were acknowledged.
        let published = self.published().revision;
        let new = records.iter().filter(|it| it.revision() > published);
        let mut new = new.map(|record| record.effects().only_adds()).peekable();
        new.peek().is_some() && (!new.all(|adds| adds) || self.host.log.points.is_busy())
    }

    /// Applies consecutive records that lead to the points of `view`, which gets the last of them.
    pub(super) fn apply_now(
        self: &Arc<Self>,
        mut applied: OwnedMutexGuard<AppliedForest>,
        records: &[Arc<Record>],
        view: impl FnOnce(&[Arc<Record>]) -> Result<Arc<dyn View>, LogError>,
    ) -> Result<(), RegistryError> {
        if self.is_retired.load(Relaxed) {
            return Err(RegistryError::Log(LogError::Closed));
        }
        let published = self.published().view.position();
        let known = records.partition_point(|record| record.revision() <= published.revision);
        self.check_known(&records[..known])?;
        let records = &records[known..];
        let position = position_after(self.uid(), published, records)?;
        if position == published {
            return Ok(());
        }
        let view = view(records)?;
        for record in records {
            self.apply_record(&mut applied.forest, record)?;
        }
        // Refusals count before readers see the records that caused them. If the records cannot be applied, the calls get
        // that error from the loop.
        let decided = self.in_flight.lock().decide(records);
        self.publish(&Arc::new(Published {
            snapshot: applied.forest.snapshot(),
            revision: position.revision,
            view,
            is_shared: self.is_shared(),
        }));
        self.start_merging(&mut applied);
        drop(applied);
        notify(decided);
        if let Err(error) = self.trim(SystemTime::now()) {
            warn!(index = self.name(), %error, "cannot trim the log");
        }
        Ok(())
    }

    /// Fails if the last of these records is not the one that was applied at its revision: the journal has lost that. Its
    /// digest covers the records before it. The newest applied record is always cached.
    fn check_known(&self, records: &[Arc<Record>]) -> Result<(), RegistryError> {
        let Some(last) = records.last() else {
            return Ok(());
        };
        let revision = last.revision();
        let applied = self.recent.lock().after(revision - 1, revision, 0);
        let mut applied = applied.iter().flatten();
        match applied.all(|applied| applied.position() == last.position()) {
            true => Ok(()),
            false => Err(LogError::replaced(self.uid(), revision).into()),
        }
    }

    fn apply_record(&self, forest: &mut Forest, record: &Arc<Record>) -> Result<(), RegistryError> {
        let effects = record.effects();
        if !effects.only_adds() {
            self.last_change.store(record.revision(), Relaxed);
        }
        let applied = forest.apply(record.revision(), effects.stored(), effects.removed());
        // This server checked its own records before it submitted them; other records may be damaged.
        applied.map_err(|_| {
            let what = "its rows are not states of the space";
            LogError::journal_damaged(self.uid(), record.revision(), what)
        })?;
        self.payload_sizes.lock().apply(record);
        if let Some(batch) = effects.batch() {
            let mut uses = self.session_uses.lock();
            uses.insert(batch.session, Instant::now());
            for ended in &batch.ended {
                uses.remove(ended);
            }
        }
        if let Some(operation) = effects.operation() {
            self.operations.lock().remember(Arc::clone(operation));
        }
        self.recent.lock().push(Arc::clone(record));
        Ok(())
    }

    /// Takes over the uses of sessions that `old` saw: this index takes its place.
    pub(super) fn take_session_uses(&self, old: &Self) {
        let mut uses = self.session_uses.lock();
        for (session, used) in old.session_uses.lock().iter() {
            // This index may have applied a newer batch already.
            uses.entry(*session).or_insert(*used);
        }
    }

    /// True if this process has applied a batch of a session within this time, by its own clock.
    pub(crate) fn is_session_used_within(&self, session: u64, time: Duration) -> bool {
        let used = self.session_uses.lock().get(&session).copied();
        used.is_some_and(|used| used.elapsed() < time)
    }
}

#[cfg(test)]
mod tests;
