//! The records of an index for those who read it from a revision on, and the wait for those that a shared journal has.

use std::{sync::Arc, time::Duration};

use futures_util::{StreamExt, stream};
use tokio::time::timeout;
use tracing::{info, warn};

use super::{Hosted, Published, Registry, RegistryError, Writer};
use crate::log::{
    Digest, Journal, LogError, Operation, Record, RecordPosition, Uid, position_after,
};

/// The time in which an index of a starting server catches up with a journal, before it is served as it is.
const CATCH_UP_TIME: Duration = Duration::from_secs(60);

/// The number of indices that catch up with a journal at a time.
const CATCHING_UP: usize = 64;

impl Registry {
    /// Waits until every index has the records that a shared journal has now. An index that cannot be followed does
    /// not delay the others. Without such a journal it does nothing.
    pub async fn catch_up(&self) {
        if !self.is_shared() {
            return;
        }
        let hosted = self.hosted();
        let indexes = hosted.len();
        let catching_up = hosted.into_iter().map(|hosted| async move {
            match timeout(CATCH_UP_TIME, hosted.catch_up()).await {
                Ok(Ok(())) => {}
                Ok(Err(error)) => {
                    warn!(index = hosted.name(), %error, "cannot catch up with the journal");
                }
                Err(_) => warn!(index = hosted.name(), "is still behind the journal"),
            }
        });
        let catching_up = stream::iter(catching_up).buffer_unordered(CATCHING_UP);
        catching_up.collect::<()>().await;
        info!(indexes, "caught up with the journal");
    }

    /// The newest revision of the journal. Blocks.
    pub(crate) fn journal_newest(&self, uid: Uid) -> Result<u64, LogError> {
        self.host.log.journal.newest(uid)
    }

    /// True if the journal has this record. Blocks.
    pub(crate) fn is_in_journal(
        &self,
        uid: Uid,
        position: RecordPosition,
    ) -> Result<bool, LogError> {
        let Some(before) = position.revision.checked_sub(1) else {
            return Ok(true);
        };
        let found = self.host.log.journal.read(uid, Some(before), 1)?;
        Ok(found
            .first()
            .is_some_and(|found| found.position() == position))
    }
}

impl Hosted {
    /// The published records after the revision `after`: the first ones that fit into `max_bytes` (see
    /// [`Effects::bytes`](crate::log::Effects::bytes)), but at least one if there is any. The error is
    /// [`LogError::Trimmed`](crate::log::LogError::Trimmed) if the log no longer holds them, and another one if a shared
    /// journal has lost them or has others in their place.
    pub async fn mutations(
        self: &Arc<Self>,
        after: u64,
        max_bytes: usize,
    ) -> Result<Vec<Arc<Record>>, RegistryError> {
        if let Some(records) = self.cached_mutations(after, max_bytes) {
            return Ok(records);
        }
        let last = self.published().revision;
        let mut records = match self.read(after, max_bytes).await {
            Ok(records) => records,
            // The journal has a gap that this server has passed with a copy of another one.
            Err(RegistryError::Log(LogError::JournalDamaged { uid, .. })) if !self.is_closed() => {
                return Err(LogError::trimmed(uid, after, last).into());
            }
            Err(error) => return Err(error),
        };
        records.retain(|record| record.revision() <= last);
        if records.is_empty() && after < last {
            // NATS has lost the records that this server has applied: a watch would read again and again.
            return Err(RegistryError::Log(LogError::JournalBehind {
                uid: self.uid(),
                head: after,
                applied: last,
            }));
        }
        if !self.is_shared() {
            return Ok(records);
        }
        let hosted = Arc::clone(self);
        let checking = move || hosted.check_applied(&records, last).map(|()| records);
        let checked = tokio::task::spawn_blocking(checking).await;
        checked.map_err(|_| RegistryError::Stopped)?
    }

    /// Fails unless these records of a shared journal are those that this server has applied, as far as it keeps their
    /// digests. `published` is its newest revision. Blocks.
    fn check_applied(&self, records: &[Arc<Record>], published: u64) -> Result<(), RegistryError> {
        let [first, rest @ ..] = records else {
            return Ok(());
        };
        let newest = rest.last().unwrap_or(first).position();
        let applied = self.digest_at(newest.revision);
        let applied = applied.map_err(|error| error.of_copy(true))?;
        if applied.is_some_and(|applied| applied != newest.digest) {
            return Err(LogError::replaced(self.uid(), newest.revision).into());
        }
        match position_after(self.uid(), first.position(), rest) {
            Ok(_) => Ok(()),
            // This server has passed the break with a copy of another one.
            Err(_) if !self.is_closed() => {
                Err(LogError::trimmed(self.uid(), first.revision() - 1, published).into())
            }
            Err(error) => Err(error.into()),
        }
    }

    /// The same, if they are in memory.
    pub(crate) fn cached_mutations(
        &self,
        after: u64,
        max_bytes: usize,
    ) -> Option<Vec<Arc<Record>>> {
        let last = self.published().revision;
        self.recent.lock().after(after, last, max_bytes)
    }

    /// The records of the journal after the revision `after`: see [`Journal::read`](crate::log::Journal::read).
    pub(super) async fn read(
        self: &Arc<Self>,
        after: u64,
        max_bytes: usize,
    ) -> Result<Vec<Arc<Record>>, RegistryError> {
        self.ask(move |journal, uid| journal.read(uid, Some(after), max_bytes))
            .await
    }

    /// Asks the journal on a thread that may block.
    async fn ask<T: Send + 'static>(
        self: &Arc<Self>,
        ask: impl FnOnce(&dyn Journal, Uid) -> Result<T, LogError> + Send + 'static,
    ) -> Result<T, RegistryError> {
        let hosted = Arc::clone(self);
        let asking = move || ask(&*hosted.host.log.journal, hosted.uid());
        let answer = tokio::task::spawn_blocking(asking).await;
        Ok(answer.map_err(|_| RegistryError::Stopped)??)
    }

    /// Waits until all records that the journal has now are published: a server that shares its journal may lag behind.
    pub async fn catch_up(self: &Arc<Self>) -> Result<(), RegistryError> {
        let newest = self.journal_newest().await?;
        self.reached(newest).await.map(drop)
    }

    /// The newest revision that the journal has.
    pub(super) async fn journal_newest(self: &Arc<Self>) -> Result<u64, RegistryError> {
        self.ask(|journal, uid| journal.newest(uid)).await
    }

    /// Fails if the journal begins after revision 0, as that of a restored index does: an index without a record is then not
    /// empty. Asks a shared journal once.
    pub(crate) async fn check_begins_empty(self: &Arc<Self>) -> Result<(), RegistryError> {
        if !self.is_shared() {
            return Ok(());
        }
        let oldest = || async {
            let oldest = self.ask(|journal, uid| journal.oldest(uid)).await?;
            Ok::<_, RegistryError>(oldest.unwrap_or(1))
        };
        match *self.oldest_at_start.get_or_try_init(oldest).await? {
            0 | 1 => Ok(()),
            oldest => Err(LogError::trimmed(self.uid(), 0, oldest - 1).into()),
        }
    }

    /// The records after `revision` up to the newest of `writer`, this index's writer; None if some are not cached.
    pub fn records_since(&self, revision: u64, writer: &Writer) -> Option<Vec<Arc<Record>>> {
        let base = writer.base().revision;
        let mut records = match revision >= base {
            true => Vec::new(),
            false => self.recent.lock().after(revision, base, usize::MAX)?,
        };
        let pending = writer
            .pending()
            .filter(|record| record.revision() > revision);
        records.extend(pending.cloned());
        Some(records)
    }

    /// The published state, and the newest operations of exactly its records, oldest first. Blocks.
    pub(crate) fn with_operations(
        &self,
    ) -> Result<(Arc<Published>, Vec<Arc<Operation>>), RegistryError> {
        // Nothing is applied meanwhile.
        let _applied = Arc::clone(&self.applied).blocking_lock_owned();
        let operations = self.host.log.points.operations(self.uid())?;
        Ok((self.published(), operations))
    }

    /// The digest of the record of a revision that this server has applied; None if the server does not keep it. Blocks.
    pub(crate) fn digest_at(&self, revision: u64) -> Result<Option<Digest>, RegistryError> {
        let position = self.published().view.position();
        if position.revision == revision {
            return Ok(Some(position.digest));
        }
        if revision == 0 {
            return Ok(Some(Record::NO_PREVIOUS));
        }
        let points = &self.host.log.points;
        if let Some(record) = points.retained(self.uid(), revision)? {
            return Ok(Some(*record.digest()));
        }
        // The oldest record in the window names the one before it.
        let next = points.retained(self.uid(), revision + 1)?;
        Ok(next.map(|next| *next.previous()))
    }
}
