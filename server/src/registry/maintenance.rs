//! What the registry sees to by itself: that a store that has failed is opened anew, that indices which nobody writes
//! are merged further, and that old records go.

use std::{
    sync::Arc,
    time::{Duration, SystemTime},
};

use tokio::time::{Instant, MissedTickBehavior, interval};
use tracing::{error, info, warn};

use super::{Hosted, IndexState, Registry, RegistryError, replay};
use crate::log::{Entry, LogError};

/// How often it is looked after.
const MAINTENANCE_INTERVAL: Duration = Duration::from_secs(1);

/// How long at most until a store that could not be opened anew is tried again.
const MAX_RETRY_WAIT: Duration = Duration::from_secs(15);

/// How often records that are too old are looked for.
const TRIM_INTERVAL: Duration = Duration::from_secs(60);

impl Registry {
    /// Looks after the registry; it never ends. Calls `recovered` whenever a log that had failed is written again.
    pub async fn maintain(self: Arc<Self>, recovered: impl Fn()) {
        let mut ticks = interval(MAINTENANCE_INTERVAL);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let (mut wait, mut next_try, mut trimmed_at) =
            (MAINTENANCE_INTERVAL, Instant::now(), Instant::now());
        let mut last_error = None;
        loop {
            let now = ticks.tick().await;
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
                        // It may last for days, and there is nothing new to say of it.
                        if last_error.as_ref() != Some(&error) {
                            warn!(%error, "the log cannot be opened anew yet");
                            last_error = Some(error);
                        }
                    }
                    // Only if it panicked, of which the panic itself has told.
                    Err(_) => wait = MAX_RETRY_WAIT,
                }
                next_try = Instant::now() + wait;
            }
            for hosted in self.hosted() {
                hosted.merge_if_idle();
            }
            if now >= trimmed_at + TRIM_INTERVAL && self.failure().is_none() {
                trimmed_at = now;
                self.trim();
            }
        }
    }

    /// Why nothing is written any more, if so.
    pub fn failure(&self) -> Option<RegistryError> {
        self.host.log.failure().map(RegistryError::Log)
    }

    /// Opens the log anew if it has failed, and takes its indices for what they are then. Those that are as far as their
    /// writers took them to be go on; any other is replayed, and who waited for it is told to ask again. It blocks.
    pub fn recover(&self) -> Result<(), RegistryError> {
        let _change = self.change_lock.lock();
        if let Err(why) = self.host.log.reopen() {
            if matches!(why, LogError::Unopened { .. }) {
                self.mark_damaged(&why);
            }
            return Err(why.into());
        }
        let entries = self.host.log.indexes()?;
        let states = self.indexes.read().clone();
        for (name, state) in &states {
            let is_stored = entries.iter().any(|entry| entry.name == *name);
            if !is_stored {
                self.change(|indexes| indexes.remove(name));
                if let IndexState::Hosted(hosted) = state {
                    hosted.close(RegistryError::Deleted);
                }
            }
        }
        for entry in &entries {
            let state = self.state_after_reopen(states.get(&entry.name), entry);
            self.change(|indexes| indexes.insert(entry.name.clone(), state));
        }
        self.add_lost();
        info!(indexes = entries.len(), "the log is written again");
        Ok(())
    }

    /// What a start would find: nothing of the log can be read any more.
    fn mark_damaged(&self, why: &LogError) {
        let gone = self.host.log.gone();
        self.change(|indexes| {
            for (name, state) in indexes.iter_mut() {
                if let IndexState::Hosted(hosted) = state {
                    let lost = gone.iter().find(|gone| gone.name == *name);
                    let why = lost.map_or(why, |gone| &gone.why).clone();
                    let uid = hosted.uid();
                    hosted.close(RegistryError::Log(why.clone()));
                    *state = IndexState::Damaged(uid, RegistryError::Log(why));
                }
            }
        });
    }

    /// What an index is after the log was opened anew.
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
        match self.host.log.points(hosted.uid()) {
            Ok(view) => hosted.resume(view),
            Err(error) => {
                error!(index = hosted.name(), %error, "cannot be read after the log was opened anew");
                false
            }
        }
    }

    fn hosted(&self) -> Vec<Arc<Hosted>> {
        let states = self.indexes.read();
        let hosted = states.values().filter_map(|state| state.hosted().ok());
        hosted.cloned().collect()
    }

    /// Forgets records that are too old, also of indices that nobody writes.
    fn trim(&self) {
        for hosted in self.hosted() {
            if let Err(error) = hosted.trim(SystemTime::now()) {
                warn!(index = hosted.name(), %error, "could not trim the log");
            }
        }
    }
}
