//! The indices that follow their journal no more: its records are damaged or trimmed, the points of this server are, or the
//! apply loop has panicked. Reads go on at the last good revision, and a copy of another server may take the place of such an
//! index.

use std::sync::{Arc, atomic::Ordering::Relaxed};

use tracing::{error, warn};

use super::{Hosted, IndexState, Registry, RegistryError};
use crate::log::{LogError, RecordPosition, Uid};

/// An index that follows its journal no more.
#[derive(Clone, Debug)]
pub(crate) struct Stopped {
    /// Its name.
    pub(crate) name: String,
    /// Its uid.
    pub(crate) uid: Uid,
    /// The newest record that this server has applied; None if its points cannot be read.
    pub(crate) position: Option<RecordPosition>,
    /// The least revision of a copy that may take its place: no reader goes backwards.
    pub(crate) min_revision: u64,
    /// True if it may go on by itself: NATS may have answered with stale data, or gets back what it has lost.
    pub(crate) may_pass: bool,
}

/// True if an index that ends with this error applies no record any more, unless its journal or its points are mended.
pub(super) fn is_damage(why: &RegistryError) -> bool {
    matches!(
        why,
        RegistryError::Stopped
            | RegistryError::Log(
                LogError::JournalDamaged { .. }
                    | LogError::JournalBehind { .. }
                    | LogError::Trimmed { .. }
                    | LogError::Contradicted { .. }
                    | LogError::CopyUnreadable { .. }
            )
    ) || revision_before(why).is_some()
}

fn contradiction(uid: Uid, revision: u64, member: &str) -> RegistryError {
    RegistryError::Log(LogError::Contradicted {
        uid,
        revision,
        member: member.to_owned(),
    })
}

/// True if a part of its points cannot be read, or a panic may have left them half changed.
fn is_unreadable(why: &RegistryError) -> bool {
    matches!(why, RegistryError::Log(LogError::CopyUnreadable { .. }))
}

/// A revision that the points of an index had, by the error that forbids to read them; None if a copy cannot mend them.
fn revision_before(why: &RegistryError) -> Option<u64> {
    let RegistryError::Log(why) = why else {
        return None;
    };
    match why {
        LogError::Lost { last, .. } => Some(*last),
        LogError::Damaged { seen, .. } => Some(*seen),
        LogError::Unreadable { .. } => Some(0),
        _ => None,
    }
}

impl Registry {
    /// The indices that a copy of another server may mend. Those that another server contradicts are not among them.
    pub(crate) fn stopped(&self) -> Vec<Stopped> {
        let indexes = self.indexes.read();
        let stopped = indexes.iter().filter_map(|(name, state)| {
            let (uid, name) = (state.uid(), name.clone());
            Some(match state {
                IndexState::Hosted(hosted) => {
                    let why = hosted.damage()?;
                    let position = hosted.published().view.position();
                    // The records of a server that has some may be the ones that the operator chooses.
                    let is_noted = position.revision > 0 && hosted.contradiction().is_some();
                    if hosted.is_contradicted() || is_noted {
                        return None;
                    }
                    Stopped {
                        name,
                        uid,
                        position: Some(position),
                        // A copy of the same record mends points that cannot be read, and nothing else.
                        min_revision: position.revision + u64::from(!is_unreadable(&why)),
                        may_pass: hosted.is_ahead(),
                    }
                }
                IndexState::Damaged(_, why) => Stopped {
                    name,
                    uid,
                    position: None,
                    min_revision: revision_before(why)?,
                    may_pass: false,
                },
            })
        });
        stopped.collect()
    }

    /// True if an index is damaged: it is not served, or follows its journal no more.
    pub fn has_damage(&self) -> bool {
        let indexes = self.indexes.read();
        let is_damaged = |state: &IndexState| match state {
            IndexState::Hosted(hosted) => hosted.problem().is_some(),
            IndexState::Damaged(..) => true,
        };
        indexes.values().any(is_damaged)
    }

    /// Closes an index for good, because `member` has applied another record of this revision. Blocks.
    pub(crate) fn close_contradicted(&self, uid: Uid, revision: u64, member: &str) {
        let Some(hosted) = self.by_uid(uid) else {
            return;
        };
        if hosted.close_again(contradiction(uid, revision, member)) {
            hosted.report_contradiction(revision, member);
        }
    }
}

impl Hosted {
    /// The damage of its journal, after which no record is applied: reads go on at the published revision.
    pub(crate) fn damage(&self) -> Option<RegistryError> {
        self.closed().filter(is_damage)
    }

    /// The reason for which nothing is written: a contradiction that any server has found, or the damage of the journal.
    pub(crate) fn problem(&self) -> Option<RegistryError> {
        self.contradiction().or_else(|| self.damage())
    }

    /// A contradiction that any server has found: nothing is written until the index has another uid.
    pub(crate) fn contradiction(&self) -> Option<RegistryError> {
        let catalogue = &self.host.log.catalogue;
        let revision = catalogue.contradiction(self.name(), self.uid())?;
        Some(contradiction(self.uid(), revision, "another server"))
    }

    /// Tells all servers that `member` has applied another record of this revision, and returns that as an error. Blocks.
    pub(crate) fn report_contradiction(&self, revision: u64, member: &str) -> RegistryError {
        let why = contradiction(self.uid(), revision, member);
        error!(index = self.name(), error = %why, "two servers contradict each other");
        self.note_contradiction(revision);
        why
    }

    /// The revision of a contradiction that closed the index, and that the other servers do not know.
    pub(super) fn unnoted_contradiction(&self) -> Option<u64> {
        match self.closed() {
            Some(RegistryError::Log(LogError::Contradicted { revision, .. })) => {
                self.contradiction().is_none().then_some(revision)
            }
            _ => None,
        }
    }

    pub(super) fn note_contradiction(&self, revision: u64) {
        let catalogue = &self.host.log.catalogue;
        if let Err(error) = catalogue.note_contradiction(self.uid(), revision) {
            warn!(index = self.name(), %error, "the other servers do not know of a contradiction yet");
        }
    }

    /// True if it is closed for a reason that may pass: a lost receipt could not be settled, or NATS may have answered
    /// with stale data, or not at all.
    pub(super) fn is_unsettled(&self) -> bool {
        matches!(
            self.closed(),
            Some(RegistryError::Log(
                LogError::Unconfirmed { .. }
                    | LogError::JournalBehind { .. }
                    | LogError::Unreachable { .. }
            ))
        )
    }

    /// True if it is closed because the journal ends before what it has applied.
    pub(super) fn is_ahead(&self) -> bool {
        matches!(
            self.closed(),
            Some(RegistryError::Log(LogError::JournalBehind { .. }))
        )
    }

    /// True if another server has applied another record in the place of one of its own.
    pub(super) fn is_contradicted(&self) -> bool {
        matches!(
            self.closed(),
            Some(RegistryError::Log(LogError::Contradicted { .. }))
        )
    }

    /// Ends a closed index for good, because a copy takes its place; false if the index is not closed, or has other records
    /// than those up to `compared`. Blocks.
    pub(super) fn retire(&self, compared: Option<RecordPosition>) -> bool {
        let _writer = Arc::clone(&self.writer).blocking_lock_owned();
        let _applied = Arc::clone(&self.applied).blocking_lock_owned();
        let is_same = compared == Some(self.published().view.position());
        let is_retired = is_same && self.is_closed();
        if is_retired {
            self.is_retired.store(true, Relaxed);
            self.close(RegistryError::Log(LogError::Closed));
        }
        is_retired
    }
}
