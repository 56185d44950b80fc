//! A gate that delays reads as a slow disk does, and that forbids them on one thread.

use std::thread::{self, ThreadId};

use parking_lot::{Condvar, Mutex};
use tokio::sync::watch;

/// The gate that every read passes.
pub(crate) struct Gate {
    /// The thread on which no read may run, if any.
    answering: Mutex<Option<ThreadId>>,
    closed: Mutex<bool>,
    opened: Condvar,
    /// The number of waiting reads.
    held: watch::Sender<usize>,
}

impl Default for Gate {
    fn default() -> Self {
        Self {
            answering: Mutex::new(None),
            closed: Mutex::new(false),
            opened: Condvar::new(),
            held: watch::Sender::new(0),
        }
    }
}

impl Gate {
    /// Delays all reads until [`Gate::open`]. From now on this thread answers calls, and a read on it panics.
    pub(crate) fn close(&self) {
        *self.answering.lock() = Some(thread::current().id());
        *self.closed.lock() = true;
    }

    /// Releases the waiting reads and delays no other.
    pub(crate) fn open(&self) {
        *self.closed.lock() = false;
        self.opened.notify_all();
    }

    /// Returns once a read waits.
    pub(crate) async fn holds_a_read(&self) {
        let mut held = self.held.subscribe();
        held.wait_for(|held| *held > 0).await.unwrap();
    }

    /// Every read calls this first.
    pub(super) fn pass(&self) {
        let answering = *self.answering.lock();
        assert_ne!(
            answering,
            Some(thread::current().id()),
            "a read on a thread that answers calls"
        );
        let mut closed = self.closed.lock();
        if *closed {
            self.held.send_modify(|held| *held += 1);
            self.opened.wait_while(&mut closed, |closed| *closed);
            self.held.send_modify(|held| *held -= 1);
        }
    }
}
