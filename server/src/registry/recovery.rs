//! Brings the indices to the state of the log and of the catalogue: after the log was reopened, after another server has
//! changed the catalogue, and after an index has stopped for a reason that may pass.

use std::{collections::BTreeSet, sync::Arc};

use tracing::{debug, error, info, warn};

use super::{Hosted, IndexState, Registry, RegistryError, replay};
use crate::log::{Entry, LogError};

impl Registry {
    /// Reopens a failed log and brings every index to its stored state. Fails if the log still cannot be written. An
    /// index resumes if its published points, with the journal's later records, give the stored ones
    /// (`Hosted::resume`). Any other index is replayed, and the calls that waited for it fail and can be retried.
    /// Blocks.
    pub fn recover(&self) -> Result<(), RegistryError> {
        let _change = self.change_lock.lock();
        if let Err(why) = self.host.log.points.reopen() {
            if matches!(why, LogError::Unopened { .. }) {
                self.mark_damaged(&why);
            }
            return Err(why.into());
        }
        let indexes = self.adopt(|before, entry| self.state_after_reopen(before, entry))?;
        // A damaged store is open for reading only.
        if let Some(why) = self.failure() {
            return Err(why);
        }
        info!(indexes, "the log is writable again");
        Ok(())
    }

    /// Serves the indices that other servers have created, and closes those that they have deleted. Blocks.
    pub(super) fn refresh(&self) -> Result<(), RegistryError> {
        let _change = self.change_lock.lock();
        self.adopt_changes()
    }

    /// Like [`Registry::refresh`], for a caller that holds the lock.
    pub(super) fn adopt_changes(&self) -> Result<(), RegistryError> {
        let adopted = self.adopt(|before, entry| match before {
            Some(state) if state.uid() == entry.uid => state.clone(),
            other => {
                if let Some(IndexState::Hosted(hosted)) = other {
                    hosted.close(RegistryError::Deleted);
                }
                replay::replay_or_damaged(&self.host, entry)
            }
        });
        adopted.map(drop)
    }

    /// Makes the served indices those of the catalogue, each in the state that `state_of` gives it by its state before.
    /// Returns their number.
    fn adopt(
        &self,
        state_of: impl Fn(Option<&IndexState>, &Entry) -> IndexState,
    ) -> Result<usize, RegistryError> {
        let entries = self.host.log.catalogue.indexes()?;
        let states = self.indexes.read().clone();
        let names: BTreeSet<_> = entries.iter().map(|entry| &entry.name).collect();
        for (name, state) in &states {
            if !names.contains(name) {
                self.change(|indexes| indexes.remove(name));
                if let IndexState::Hosted(hosted) = state {
                    hosted.close(RegistryError::Deleted);
                }
            }
        }
        for entry in &entries {
            let state = state_of(states.get(&entry.name), entry);
            self.change(|indexes| indexes.insert(entry.name.clone(), state));
        }
        self.add_lost();
        Ok(entries.len())
    }

    /// Marks every index as damaged, as a restart would: the log is unreadable.
    fn mark_damaged(&self, why: &LogError) {
        let lost = self.host.log.catalogue.lost();
        self.change(|indexes| {
            for (name, state) in indexes.iter_mut() {
                if let IndexState::Hosted(hosted) = state {
                    let lost = lost.iter().find(|lost| lost.name == *name);
                    let why = lost.map_or(why, |lost| &lost.why).clone();
                    let uid = hosted.uid();
                    hosted.close(RegistryError::Log(why.clone()));
                    *state = IndexState::Damaged(uid, RegistryError::Log(why));
                }
            }
        });
    }

    /// The state of an index after the log was reopened.
    fn state_after_reopen(&self, before: Option<&IndexState>, entry: &Entry) -> IndexState {
        if let Some(IndexState::Hosted(hosted)) = before {
            if hosted.uid() == entry.uid && self.resumes(hosted) {
                return IndexState::Hosted(Arc::clone(hosted));
            }
            hosted.close(RegistryError::Log(LogError::Closed));
        }
        replay::replay_or_damaged(&self.host, entry)
    }

    fn resumes(&self, hosted: &Arc<Hosted>) -> bool {
        match self.host.log.points.view(hosted.uid()) {
            Ok(view) => hosted.resume(&view),
            Err(error) => {
                error!(index = hosted.name(), %error, "cannot read an index after the log was reopened");
                false
            }
        }
    }

    /// Resumes an index whose calls failed with an unknown outcome. That is safe: its next record is refused if a
    /// record of those calls is in the journal. A journal that has lost records gets them again first.
    pub(super) async fn resume_unsettled(self: &Arc<Self>, hosted: &Arc<Hosted>) {
        let (registry, hosted) = (Arc::clone(self), Arc::clone(hosted));
        let resume = move || {
            let journal = &registry.host.log.journal;
            if hosted.is_ahead() && journal.is_reachable() {
                match journal.repair(hosted.uid()) {
                    Ok(0) => {}
                    Ok(records) => warn!(
                        index = hosted.name(),
                        records,
                        "the journal had lost its newest records, and has them again from this server"
                    ),
                    Err(LogError::Contradicted {
                        revision, member, ..
                    }) => registry.close_contradicted(hosted.uid(), revision, &member),
                    // The reason was reported when the index stopped.
                    Err(error) => {
                        debug!(index = hosted.name(), %error, "cannot repair the journal")
                    }
                }
            }
            // Resumed, an index ahead of its journal would be open until its follower notices that again.
            (!hosted.is_ahead() || registry.is_reached(&hosted)) && registry.resumes(&hosted)
        };
        // The join fails only if the task panicked; the panic hook has printed it.
        let _ = tokio::task::spawn_blocking(resume).await;
    }

    /// True if the journal ends at or after the newest record that an index has applied. Blocks.
    fn is_reached(&self, hosted: &Hosted) -> bool {
        let journal = &self.host.log.journal;
        let applied = hosted.published().revision;
        journal.is_reachable()
            && journal
                .newest(hosted.uid())
                .is_ok_and(|newest| newest >= applied)
    }
}

#[cfg(test)]
mod tests;
