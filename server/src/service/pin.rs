//! A revision held for a stream, for as long as a stream may.

use std::{sync::Arc, time::Duration};

use parking_lot::Mutex;
use tokio::sync::oneshot;

use crate::registry::Published;

/// A pinned revision. It is let go of when this is dropped or when the time is up, also while nobody asks for it.
pub(super) struct Pin {
    held: Arc<Mutex<Option<Arc<Published>>>>,
    seconds: u64,
    /// Ends the watch over the time together with the pin.
    _watch: oneshot::Sender<()>,
}

impl Pin {
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
            _watch: watch,
        }
    }

    /// The revision, unless the time is up.
    pub(super) fn get(&self) -> Option<Arc<Published>> {
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
