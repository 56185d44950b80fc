//! Periodic maintenance: reopens a failed store, merges idle indices further, trims old records, and gives freed memory
//! back to the system.

use std::{
    future::pending,
    sync::Arc,
    time::{Duration, SystemTime},
};

use tokio::{
    sync::watch,
    time::{Instant, MissedTickBehavior, interval},
};
use tracing::warn;

use super::Registry;
use crate::watermark::release_to_os;

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

    /// Trims old records, in idle indices too. On disk the next record of an index removes them.
    fn trim(&self) {
        for hosted in self.hosted() {
            if let Err(error) = hosted.trim(SystemTime::now()) {
                warn!(index = hosted.name(), %error, "cannot trim the log");
            }
        }
    }
}
