//! A revision held for a stream, for a bounded time.

use std::{sync::Arc, time::Duration};

use parking_lot::Mutex;
use tokio::{sync::oneshot, time::Instant};

use crate::registry::Published;

/// A pinned revision. A drop releases it, and so does the end of its time, even if no reader comes back.
pub(super) struct RevisionPin {
    held: Arc<Mutex<Option<Arc<Published>>>>,
    seconds: u64,
    /// The end of its time, which a reader must see before the watch has run. None lies beyond what the clock can tell.
    end: Option<Instant>,
    /// Ends the watch over the time together with the pin.
    _watch: oneshot::Sender<()>,
}

impl RevisionPin {
    /// Holds `published` for `seconds`.
    pub(super) fn new(published: Arc<Published>, seconds: u64) -> Self {
        let held = Arc::new(Mutex::new(Some(published)));
        let (watch, ended) = oneshot::channel();
        let watched = Arc::clone(&held);
        tokio::spawn(async move {
            let time = Duration::from_secs(seconds);
            if tokio::time::timeout(time, ended).await.is_err() {
                watched.lock().take();
            }
        });
        Self {
            held,
            seconds,
            end: Instant::now().checked_add(Duration::from_secs(seconds)),
            _watch: watch,
        }
    }

    /// The revision, unless the time is up.
    pub(super) fn get(&self) -> Option<Arc<Published>> {
        if self.end.is_some_and(|end| Instant::now() >= end) {
            self.release();
        }
        self.held.lock().clone()
    }

    /// For how many seconds it may be held.
    pub(super) fn seconds(&self) -> u64 {
        self.seconds
    }

    /// Lets go of it.
    pub(super) fn release(&self) {
        self.held.lock().take();
    }
}
