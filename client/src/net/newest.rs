//! The newest revisions that a client has seen.

use std::{
    collections::HashMap,
    sync::{
        Arc,
        atomic::{AtomicU64, AtomicUsize, Ordering},
    },
};

use parking_lot::Mutex;

use crate::Revision;

/// The newest revision of an index that an answer named.
#[derive(Debug)]
pub(crate) struct Newest {
    number: AtomicU64,
    /// The turn of the connection whose server has reached it for certain.
    reached_in: AtomicUsize,
}

/// The newest revisions by the uids of their indices.
#[derive(Debug, Default)]
pub(crate) struct NewestRevisions(Mutex<HashMap<Arc<str>, Arc<Newest>>>);

impl Newest {
    pub(crate) fn new(number: u64) -> Newest {
        Newest {
            number: AtomicU64::new(number),
            // No connection has this turn.
            reached_in: AtomicUsize::new(usize::MAX),
        }
    }

    pub(crate) fn number(&self) -> u64 {
        self.number.load(Ordering::Acquire)
    }

    /// An answer named this revision.
    pub(crate) fn note(&self, number: u64) {
        self.number.fetch_max(number, Ordering::AcqRel);
    }

    pub(crate) fn is_reached_in(&self, turn: usize) -> bool {
        self.reached_in.load(Ordering::Acquire) == turn
    }

    pub(crate) fn set_reached_in(&self, turn: usize) {
        self.reached_in.store(turn, Ordering::Release);
    }
}

impl NewestRevisions {
    /// The newest revision of this uid, which is at least this one.
    pub(crate) fn of(&self, revision: &Revision) -> Arc<Newest> {
        let mut all = self.0.lock();
        let newest = all.entry(Arc::clone(&revision.uid));
        let newest = newest.or_insert_with(|| Arc::new(Newest::new(0)));
        newest.note(revision.number);
        Arc::clone(newest)
    }

    /// The index was deleted.
    pub(crate) fn forget(&self, uid: &str) {
        self.0.lock().remove(uid);
    }
}
