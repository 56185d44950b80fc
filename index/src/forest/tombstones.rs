//! The revisions that removed points of a tree.

use std::sync::{
    OnceLock,
    atomic::{AtomicU64, AtomicUsize, Ordering::Relaxed},
};

/// One tombstone for each slot, allocated by the chunk when its first point dies: most levels never need them.
///
/// The writer marks points while readers look. A reader at revision r sees a point unless it died at r or before, and
/// the writer only writes revisions that no reader has yet. So a reader decides the same with the old mark and with the
/// new one. Publishing a revision, through the lock or channel that passes a snapshot on, orders its marks before it,
/// so relaxed accesses are enough.
#[derive(Debug, Default)]
pub(super) struct Tombstones {
    chunks: OnceLock<Box<[Chunk]>>,
    dead: AtomicUsize,
}

/// The number of slots in a chunk.
const CHUNK_ROWS: usize = 256;

type Chunk = OnceLock<Box<[AtomicU64; CHUNK_ROWS]>>;

const ALIVE: u64 = u64::MAX;

/// A reader at this revision sees no point that has died.
pub(super) const LATEST: u64 = ALIVE - 1;

impl Tombstones {
    /// Marks the point in `slot`, one of `slots`, as removed by `revision`. The point must be alive.
    pub(super) fn mark_dead(&self, slot: usize, slots: usize, revision: u64) {
        let make = || {
            (0..slots.div_ceil(CHUNK_ROWS))
                .map(|_| Chunk::new())
                .collect()
        };
        let chunks = self.chunks.get_or_init(make);
        let alive = || Box::new([const { AtomicU64::new(ALIVE) }; CHUNK_ROWS]);
        let died = &chunks[slot / CHUNK_ROWS].get_or_init(alive)[slot % CHUNK_ROWS];
        debug_assert_eq!(died.load(Relaxed), ALIVE, "a point dies once");
        died.store(revision, Relaxed);
        self.dead.fetch_add(1, Relaxed);
    }

    /// True if a reader at `revision` sees the point in `slot`.
    pub(super) fn is_visible(&self, slot: usize, revision: u64) -> bool {
        let Some(chunks) = self.chunks.get() else {
            return true;
        };
        let chunk = chunks[slot / CHUNK_ROWS].get();
        chunk.is_none_or(|died| died[slot % CHUNK_ROWS].load(Relaxed) > revision)
    }

    /// The number of points dead at the head.
    pub(super) fn dead(&self) -> usize {
        self.dead.load(Relaxed)
    }

    pub(super) fn memory_bytes(&self) -> usize {
        let chunks = self.chunks.get().map_or(&[][..], |chunks| chunks);
        let made = chunks.iter().filter(|chunk| chunk.get().is_some());
        size_of_val(chunks) + made.count() * size_of::<[AtomicU64; CHUNK_ROWS]>()
    }
}
