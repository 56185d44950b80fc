//! A gate that delays reads as a slow disk does, and that forbids them on one thread.

use std::thread::{self, ThreadId};

use parking_lot::{Condvar, Mutex};
use tokio::sync::watch;

/// The gate that every read passes.
pub(crate) struct Gate {
    /// The thread on which no read may run, if any.
    answering: Mutex<Option<ThreadId>>,
    door: Mutex<Door>,
    opened: Condvar,
    /// The number of waiting reads.
    held: watch::Sender<usize>,
}

#[derive(Default)]
struct Door {
    is_closed: bool,
    /// The number of times that the waiting reads were released.
    releases: u64,
}

impl Default for Gate {
    fn default() -> Self {
        Self {
            answering: Mutex::new(None),
            door: Mutex::default(),
            opened: Condvar::new(),
            held: watch::Sender::new(0),
        }
    }
}

impl Gate {
    /// Delays all reads until [`Gate::open`]. From now on this thread answers calls, and a read on it panics.
    pub(crate) fn close(&self) {
        *self.answering.lock() = Some(thread::current().id());
        self.door.lock().is_closed = true;
    }

    /// Releases the waiting reads and delays no other.
    pub(crate) fn open(&self) {
        self.door.lock().is_closed = false;
        self.release();
    }

    /// Releases the waiting reads; a closed gate delays the next ones.
    pub(crate) fn release(&self) {
        let mut door = self.door.lock();
        door.releases += 1;
        self.held.send_replace(0);
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
        let mut door = self.door.lock();
        if door.is_closed {
            self.held.send_modify(|held| *held += 1);
            let releases = door.releases;
            self.opened
                .wait_while(&mut door, |door| door.releases == releases);
        }
    }
}
