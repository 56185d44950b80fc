//! The settlement of receipts: what the journal has instead of a submitted record that it has refused, or whose receipt was
//! lost.

use std::{sync::Arc, time::Duration};

use tokio::time::{Instant, interval, timeout_at};

use super::{Hosted, RegistryError, in_flight::notify};
use crate::log::{Effects, LogError, Receipt, Record, RecordPosition};

/// The longest time until a lost receipt is settled, or until the record arrives that took the place of another. After it
/// the calls fail.
pub(super) const SETTLE_TIME: Duration = Duration::from_secs(5);

/// The time between two attempts to settle a lost receipt.
pub(super) const SETTLE_INTERVAL: Duration = Duration::from_millis(50);

/// A journal that ends before an applied record is asked again for this long: NATS may answer with stale data while it
/// changes a leader.
const BEHIND_TIME: Duration = Duration::from_secs(2);

/// A record that the journal can never have, and the end of the journal that showed it.
pub(super) type VoidRecord = (RecordPosition, u64);

impl Hosted {
    /// Finds out what the journal has instead of a record whose receipt is this error. Returns its arrival.
    pub(super) async fn not_accepted(
        self: &Arc<Self>,
        record: &Record,
        base: RecordPosition,
        error: LogError,
        void: &mut Option<VoidRecord>,
    ) -> Result<impl Future<Output = Result<(), RegistryError>> + use<>, RegistryError> {
        let journal_end = match (error, *void) {
            (LogError::Fenced { head, .. }, _) => head,
            // The publisher sends a record only after the one that it follows.
            (LogError::Unconfirmed { .. }, Some((before, end))) if record.follows(before) => end,
            (error @ LogError::Unconfirmed { .. }, _) => self.settle(record, error).await?,
            (error, _) => return Err(error.into()),
        };
        let journal_end = self.journal_has(base, journal_end).await?;
        Ok(self.superseded(record, journal_end, void))
    }

    /// Fails if the journal, which ends at the revision `journal_end`, does not have the applied record `base` or ends
    /// before the newest applied one: records may have been acknowledged since `base`. Returns its end.
    async fn journal_has(
        self: &Arc<Self>,
        base: RecordPosition,
        mut journal_end: u64,
    ) -> Result<u64, RegistryError> {
        let applied = base.revision.max(self.published().revision);
        let until = Instant::now() + BEHIND_TIME;
        let mut attempts = interval(SETTLE_INTERVAL);
        while journal_end < applied && Instant::now() < until {
            attempts.tick().await;
            journal_end = self.journal_newest().await.unwrap_or(journal_end);
        }
        if journal_end < applied {
            return Err(RegistryError::Log(LogError::JournalBehind {
                uid: self.uid(),
                head: journal_end,
                applied,
            }));
        }
        // Another record may have taken its place after the journal had lost it.
        if journal_end > base.revision || base.revision == 0 {
            return Ok(journal_end);
        }
        let found = self.read(base.revision - 1, 1).await?;
        match found.first().is_none_or(|found| found.position() == base) {
            true => Ok(journal_end),
            false => Err(RegistryError::Log(LogError::replaced(
                self.uid(),
                base.revision,
            ))),
        }
    }

    /// Waits until the record in the place of `record` is published. If the journal ends before it, refuses `record` and
    /// waits for the record at `journal_end`.
    fn superseded(
        &self,
        record: &Record,
        journal_end: u64,
        void: &mut Option<VoidRecord>,
    ) -> impl Future<Output = Result<(), RegistryError>> + use<> {
        // The record that has its place comes from the journal and decides. If none has it, none may ever come.
        if journal_end < record.revision() {
            *void = Some((record.position(), journal_end));
            let decided = self.in_flight.lock().mark_refused(record.position());
            notify(decided);
        }
        self.arrival(journal_end.min(record.revision()))
    }

    /// Settles a record whose receipt was lost: an empty record is submitted in its place. If the journal takes that
    /// one, the lost record can never be there; if it refuses, a record is there, or the record before it is not. In both
    /// cases the records that come from the journal decide, up to the returned revision. NATS may refuse because of
    /// stale data.
    async fn settle(
        self: &Arc<Self>,
        record: &Record,
        error: LogError,
    ) -> Result<u64, RegistryError> {
        // Nothing is submitted meanwhile.
        let _writer = self.write_closed().await;
        let until = Instant::now() + SETTLE_TIME;
        let mut attempts = interval(SETTLE_INTERVAL);
        let previous = RecordPosition {
            revision: record.revision() - 1,
            digest: *record.previous(),
        };
        while self.published().revision <= previous.revision {
            attempts.tick().await;
            let fence = Record::made_by(
                self.host.run,
                previous,
                Effects::new(self.space().coordinates()),
            );
            let fence = Arc::new(fence);
            let outcome = match self.host.log.journal.submit(self.uid(), fence) {
                Ok(Receipt::Accepted) => Ok(()),
                Ok(Receipt::Awaited(outcome)) => match timeout_at(until, outcome).await {
                    Ok(outcome) => outcome,
                    Err(_) => Err(error.clone()),
                },
                Err(error) => Err(error),
            };
            match outcome {
                Ok(()) => break,
                Err(LogError::Fenced { head, .. }) if self.is_settled(previous, head).await => {
                    return Ok(head);
                }
                Err(LogError::Fenced { head, .. }) => {
                    self.journal_has(RecordPosition::START, head).await?;
                }
                Err(LogError::Unconfirmed { .. }) => {}
                Err(error) => return Err(error.into()),
            }
            if Instant::now() >= until {
                return Err(error.into());
            }
        }
        Ok(record.revision())
    }

    /// True if a journal that ends at the revision `journal_end` has a record after `previous`, or another one in its place.
    async fn is_settled(self: &Arc<Self>, previous: RecordPosition, journal_end: u64) -> bool {
        if journal_end != previous.revision {
            return journal_end > previous.revision;
        }
        let found = self.read(journal_end.saturating_sub(1), 1).await;
        let is_other = |it: &Arc<Record>| it.revision() == journal_end && it.position() != previous;
        found.is_ok_and(|found| found.iter().any(is_other))
    }
}
