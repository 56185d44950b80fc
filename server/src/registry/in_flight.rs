//! The records of an index that were submitted and are not yet applied, and the calls that wait for them.

use std::{collections::VecDeque, sync::Arc};

use tokio::sync::oneshot;

use super::RegistryError;
use crate::log::{Record, RecordPosition};

/// The end of a submitted record.
#[derive(Clone, Debug)]
pub(super) enum Decision {
    /// It is published.
    Published,
    /// Another writer's record took its revision. The mutation must be evaluated again.
    Refused,
    /// The index cannot tell, or serves no more writes.
    Failed(RegistryError),
}

/// The submitted records of an index that are not yet applied.
#[derive(Default)]
pub(super) struct InFlight {
    /// The records, oldest first, with consecutive revisions.
    records: VecDeque<SubmittedRecord>,
    refusals: u64,
    /// The newest revision whose record is known.
    decided: u64,
}

struct SubmittedRecord {
    position: RecordPosition,
    /// True if the journal refused it. It is void once the records before it are decided.
    is_refused: bool,
    waiting: Vec<oneshot::Sender<Decision>>,
}

/// Calls to notify once the index has published what decided their records.
pub(super) type Notifications = Vec<(oneshot::Sender<Decision>, Decision)>;

impl InFlight {
    /// The number of times that records were refused. The pending records of an earlier count are void.
    pub(super) fn refusals(&self) -> u64 {
        self.refusals
    }

    /// The number of submitted records.
    pub(super) fn len(&self) -> usize {
        self.records.len()
    }

    /// Adds the next record, evaluated when the refusals were at this number. It is refused at once if another record
    /// has its revision, or if a record that it follows was refused. The error is then the revision to wait for before
    /// the next attempt.
    pub(super) fn add(
        &mut self,
        position: RecordPosition,
        refusals: u64,
    ) -> Result<oneshot::Receiver<Decision>, u64> {
        if position.revision <= self.decided || self.refusals != refusals {
            return Err(self.decided);
        }
        self.records.push_back(SubmittedRecord {
            position,
            is_refused: false,
            waiting: Vec::new(),
        });
        Ok(self.wait_for_last())
    }

    /// Takes back the last record, which the journal did not take.
    pub(super) fn take_back(&mut self, position: RecordPosition) {
        self.records.pop_back_if(|last| last.position == position);
    }

    /// Waits for the record `position`, which was submitted when the refusals were at this number.
    pub(super) fn wait_for(
        &mut self,
        position: RecordPosition,
        refusals: u64,
    ) -> oneshot::Receiver<Decision> {
        match self.records.back() {
            Some(last) if last.position == position => self.wait_for_last(),
            _ => {
                let (sender, receiver) = oneshot::channel();
                let decision = match self.refusals == refusals {
                    true => Decision::Published,
                    false => Decision::Refused,
                };
                // The receiver is held in this scope.
                let _ = sender.send(decision);
                receiver
            }
        }
    }

    fn wait_for_last(&mut self) -> oneshot::Receiver<Decision> {
        let (sender, receiver) = oneshot::channel();
        if let Some(last) = self.records.back_mut() {
            last.waiting.push(sender);
        }
        receiver
    }

    /// Decides each submitted record by the record that the journal has at its revision.
    pub(super) fn decide(&mut self, records: &[Arc<Record>]) -> Notifications {
        let mut decided = Notifications::new();
        let last = records.last().map_or(0, |last| last.revision());
        self.decided = self.decided.max(last);
        for record in records {
            let Some(first) = self.records.front() else {
                break;
            };
            if first.position != record.position() {
                self.refuse(&mut decided);
                break;
            }
            let first = self.records.pop_front().into_iter();
            let waiting = first.flat_map(|first| first.waiting);
            decided.extend(waiting.map(|waiting| (waiting, Decision::Published)));
        }
        self.refuse_first(&mut decided);
        decided
    }

    /// Notes that the journal refused this record without having another one in its place: an earlier record was lost.
    pub(super) fn mark_refused(&mut self, position: RecordPosition) -> Notifications {
        let mut decided = Notifications::new();
        if let Some(refused) = self
            .records
            .iter_mut()
            .find(|record| record.position == position)
        {
            refused.is_refused = true;
            self.refuse_first(&mut decided);
        }
        decided
    }

    /// Refuses all records if the journal refused the first.
    fn refuse_first(&mut self, decided: &mut Notifications) {
        if self.records.front().is_some_and(|first| first.is_refused) {
            self.refuse(decided);
        }
    }

    fn refuse(&mut self, decided: &mut Notifications) {
        self.refusals += 1;
        let waiting = self.records.drain(..).flat_map(|record| record.waiting);
        decided.extend(waiting.map(|waiting| (waiting, Decision::Refused)));
    }

    /// Forgets all submitted records: it is unknown which of them are in the journal.
    pub(super) fn fail(&mut self, why: &RegistryError) -> Notifications {
        self.refusals += 1;
        let waiting = self.records.drain(..).flat_map(|record| record.waiting);
        let failed = waiting.map(|waiting| (waiting, Decision::Failed(why.clone())));
        failed.collect()
    }
}

/// Notifies calls.
pub(super) fn notify(decided: Notifications) {
    for (waiting, decision) in decided {
        // The caller may have left.
        let _ = waiting.send(decision);
    }
}
