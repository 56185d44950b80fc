//! Periodic maintenance: reopens a failed store, merges idle indices further, trims old records, and gives freed memory
//! back to the system.

use std::{
    collections::BTreeSet,
    future::pending,
    sync::Arc,
    time::{Duration, SystemTime},
};

use tokio::{
    sync::watch,
    time::{Instant, MissedTickBehavior, interval},
};
use tracing::{debug, error, info, warn};

use super::{Hosted, IndexState, Registry, RegistryError, replay};
use crate::{
    log::{Entry, LogError},
    watermark::release_to_os,
};

/// The time between two rounds of maintenance.
const MAINTENANCE_INTERVAL: Duration = Duration::from_secs(1);

/// The longest wait before the next attempt to reopen a failed store.
const MAX_RETRY_WAIT: Duration = Duration::from_secs(15);

/// Waits for a change that another server makes to the catalogue.
async fn changed(catalogue: &mut Option<watch::Receiver<()>>) {
    if let Some(changes) = catalogue
        && changes.changed().await.is_ok()
    {
        return;
    }
    pending().await
}

impl Registry {
    /// Maintains the registry forever. Calls `recovered` each time a failed log becomes writable again.
    pub async fn maintain(self: Arc<Self>, recovered: impl Fn()) {
        let mut ticks = interval(MAINTENANCE_INTERVAL);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let (mut wait, mut next_try, mut trimmed_at) =
            (MAINTENANCE_INTERVAL, Instant::now(), Instant::now());
        let mut last_error = None;
        let mut catalogue = self.host.log.catalogue.changes();
        // True if the last changes of the catalogue are not adopted.
        let mut is_stale = false;
        loop {
            let now = tokio::select! {
                now = ticks.tick() => now,
                () = changed(&mut catalogue) => {
                    let registry = Arc::clone(&self);
                    let refreshed = tokio::task::spawn_blocking(move || registry.refresh()).await;
                    if let Ok(Err(error)) = refreshed {
                        warn!(%error, "cannot adopt the changes of the catalogue yet");
                        is_stale = true;
                    }
                    continue;
                }
            };
            if std::mem::take(&mut is_stale)
                && let Some(catalogue) = &mut catalogue
            {
                catalogue.mark_changed();
            }
            if self.failure().is_some() && now >= next_try {
                let registry = Arc::clone(&self);
                let outcome = tokio::task::spawn_blocking(move || registry.recover()).await;
                match outcome {
                    Ok(Ok(())) => {
                        (wait, last_error) = (MAINTENANCE_INTERVAL, None);
                        recovered();
                    }
                    Ok(Err(error)) => {
                        wait = (2 * wait).min(MAX_RETRY_WAIT);
                        // The failure may last for days: log it only when it changes.
                        if last_error.as_ref() != Some(&error) {
                            warn!(%error, "cannot reopen the log yet");
                            last_error = Some(error);
                        }
                    }
                    // The join fails only if the task panicked; the panic hook has printed it.
                    Err(_) => wait = MAX_RETRY_WAIT,
                }
                next_try = Instant::now() + wait;
            }
            for hosted in self.hosted() {
                if hosted.is_unsettled() {
                    self.resume_unsettled(&hosted).await;
                }
                if let Some(revision) = hosted.unnoted_contradiction() {
                    let noting = Arc::clone(&hosted);
                    let note = move || noting.note_contradiction(revision);
                    // The join fails only if the task panicked; the panic hook has printed it.
                    let _ = tokio::task::spawn_blocking(note).await;
                }
                hosted.merge_if_idle();
            }
            let registry = Arc::clone(&self);
            let blocking = move || {
                if registry.is_any_loadable() {
                    registry.load_rest();
                }
                release_to_os(false);
            };
            // The join fails only if the task panicked; the panic hook has printed it.
            let _ = tokio::task::spawn_blocking(blocking).await;
            if now >= trimmed_at + self.trim_interval() && self.failure().is_none() {
                trimmed_at = now;
                self.trim();
            }
        }
    }

    /// True while the journal cannot be reached: records of others do not arrive.
    pub fn is_cut_off(&self) -> bool {
        !self.host.log.journal.is_reachable()
    }

    /// True if mutations that add points are accepted now: the store has not failed, the journal can be reached, and
    /// memory and disk are below their watermarks.
    pub fn accepts_growth(&self) -> bool {
        self.failure().is_none() && !self.is_cut_off() && self.host.watermarks.check().is_ok()
    }

    /// The error of a log that has stopped accepting writes.
    pub fn failure(&self) -> Option<RegistryError> {
        self.host.log.points.failure().map(RegistryError::Log)
    }

    /// Reopens a failed log and brings every index to its stored state. Fails if the log still cannot be written. An
    /// index whose stored revision is its writer's head resumes. Any other index is replayed, and the calls that waited
    /// for it fail and can be retried. Blocks.
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
    fn refresh(&self) -> Result<(), RegistryError> {
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

    pub(super) fn hosted(&self) -> Vec<Arc<Hosted>> {
        let states = self.indexes.read();
        let hosted = states.values().filter_map(|state| state.hosted().ok());
        hosted.cloned().collect()
    }

    /// True if there is memory now for an index that was not loaded.
    fn is_any_loadable(&self) -> bool {
        let states = self.indexes.read();
        states.values().any(|state| self.is_loadable(state))
    }

    fn is_loadable(&self, state: &IndexState) -> bool {
        match state {
            IndexState::Damaged(_, RegistryError::NotLoaded { needed, .. }) => {
                let memory = self.host.watermarks.memory.as_ref();
                memory.is_none_or(|memory| memory.fits_at_start(*needed).is_ok())
            }
            IndexState::Hosted(_) | IndexState::Damaged(..) => false,
        }
    }

    /// Loads the indices that were not loaded, as far as there is memory for them now. Blocks.
    pub fn load_rest(&self) {
        let _change = self.change_lock.lock();
        let Ok(entries) = self.host.log.catalogue.indexes() else {
            return;
        };
        for entry in &entries {
            let state = self.indexes.read().get(&entry.name).cloned();
            if state.is_some_and(|state| self.is_loadable(&state)) {
                let state = replay::replay_or_damaged(&self.host, entry);
                self.change(|indexes| indexes.insert(entry.name.clone(), state));
            }
        }
    }

    /// Resumes an index whose calls failed with an unknown outcome. That is safe: its next record is refused if a
    /// record of those calls is in the journal. A journal that has lost records gets them again first.
    async fn resume_unsettled(self: &Arc<Self>, hosted: &Arc<Hosted>) {
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
                    }) => registry.contradicted(hosted.uid(), revision, &member),
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

    /// Trims old records, in idle indices too. On disk the next record of an index removes them.
    fn trim(&self) {
        for hosted in self.hosted() {
            if let Err(error) = hosted.trim(SystemTime::now()) {
                warn!(index = hosted.name(), %error, "cannot trim the log");
            }
        }
    }
}

#[cfg(test)]
mod tests;
