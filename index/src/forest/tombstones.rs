//! Which points of an immutable level have been removed, and by which revision.

use std::sync::{
    OnceLock,
    atomic::{AtomicU64, AtomicUsize, Ordering::Relaxed},
};

/// One mark a slot, made in chunks when the first point of a chunk dies: most levels never need them.
///
/// The writer marks while readers look. A reader at revision r sees a point iff it did not die at r or before, and the
/// writer only writes revisions that no reader has been given yet: whether a reader meets the old mark or the new one,
/// it decides the same. Publishing a revision (through whatever lock or channel hands a snapshot over) orders the
/// marks before it, so that relaxed accesses are enough.
#[derive(Debug, Default)]
pub(super) struct Tombstones {
    chunks: OnceLock<Box<[Chunk]>>,
    dead: AtomicUsize,
}

/// Marks of so many slots are made at once.
const CHUNK: usize = 256;

type Chunk = OnceLock<Box<[AtomicU64; CHUNK]>>;

const ALIVE: u64 = u64::MAX;

/// A revision at which all is dead that has died.
pub(super) const HEAD: u64 = ALIVE - 1;

impl Tombstones {
    /// Marks the point in `slot`, one of `slots`, as removed by `revision`. It must be alive.
    pub(super) fn bury(&self, slot: usize, slots: usize, revision: u64) {
        let make = || (0..slots.div_ceil(CHUNK)).map(|_| Chunk::new()).collect();
        let chunks = self.chunks.get_or_init(make);
        let alive = || Box::new([const { AtomicU64::new(ALIVE) }; CHUNK]);
        let died = &chunks[slot / CHUNK].get_or_init(alive)[slot % CHUNK];
        debug_assert_eq!(died.load(Relaxed), ALIVE, "a point dies once");
        died.store(revision, Relaxed);
        self.dead.fetch_add(1, Relaxed);
    }

    /// Whether a reader at `revision` sees the point in `slot`.
    pub(super) fn sees(&self, slot: usize, revision: u64) -> bool {
        let Some(chunks) = self.chunks.get() else {
            return true;
        };
        let chunk = chunks[slot / CHUNK].get();
        chunk.is_none_or(|died| died[slot % CHUNK].load(Relaxed) > revision)
    }

    /// How many points are dead at the head.
    pub(super) fn dead(&self) -> usize {
        self.dead.load(Relaxed)
    }

    pub(super) fn memory_bytes(&self) -> usize {
        let chunks = self.chunks.get().map_or(&[][..], |chunks| chunks);
        let made = chunks.iter().filter(|chunk| chunk.get().is_some());
        size_of_val(chunks) + made.count() * size_of::<[AtomicU64; CHUNK]>()
    }
}
