//! Which points of an immutable level have been removed, and by which revision.

use std::sync::{
    OnceLock,
    atomic::{AtomicU64, AtomicUsize, Ordering::Relaxed},
};

/// One mark a slot, made when the first point dies: most levels never need them.
///
/// The writer marks while readers look. A reader at revision r sees a point iff it did not die at r or before, and the
/// writer only writes revisions that no reader has been given yet: whether a reader meets the old mark or the new one,
/// it decides the same. Publishing a revision (through whatever lock or channel hands a snapshot over) orders the
/// marks before it, so that relaxed accesses are enough.
#[derive(Debug, Default)]
pub(super) struct Tombstones {
    died: OnceLock<Box<[AtomicU64]>>,
    dead: AtomicUsize,
}

const ALIVE: u64 = u64::MAX;

impl Tombstones {
    /// Marks the point in `slot`, one of `slots`, as removed by `revision`. It must be alive.
    pub(super) fn bury(&self, slot: usize, slots: usize, revision: u64) {
        let died = self
            .died
            .get_or_init(|| (0..slots).map(|_| AtomicU64::new(ALIVE)).collect());
        debug_assert_eq!(died[slot].load(Relaxed), ALIVE, "a point dies once");
        died[slot].store(revision, Relaxed);
        self.dead.fetch_add(1, Relaxed);
    }

    /// Whether a reader at `revision` sees the point in `slot`.
    pub(super) fn sees(&self, slot: usize, revision: u64) -> bool {
        self.died
            .get()
            .is_none_or(|died| died[slot].load(Relaxed) > revision)
    }

    /// How many points are dead at the head.
    pub(super) fn dead(&self) -> usize {
        self.dead.load(Relaxed)
    }

    pub(super) fn memory_bytes(&self) -> usize {
        self.died.get().map_or(0, |died| size_of_val(&**died))
    }
}
