//! A revision pinned for a stream, for a bounded time.

use std::{sync::Arc, time::Duration};

use parking_lot::Mutex;
use tokio::{sync::oneshot, time::Instant};

use crate::registry::Published;

/// A pinned revision. A drop or the end of its time releases it, even if no reader returns.
pub(super) struct RevisionPin {
    held: Arc<Mutex<Option<Arc<Published>>>>,
    /// The seconds that it may be held.
    pub(super) seconds: u64,
    /// The end of its time: a reader checks it, as the watching task may run late. None: beyond the clock's range.
    end: Option<Instant>,
    /// Its drop ends the watching task.
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

    /// Releases the revision.
    pub(super) fn release(&self) {
        self.held.lock().take();
    }
}
