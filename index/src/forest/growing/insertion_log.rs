//! The points of a growing tree in the order of insertion.

use std::sync::Arc;

use crate::{
    Point, PointRef, Points,
    blocks::Blocks,
    lanes::{BLOCK_ROWS, Isa},
    traversal::{Labels, Traversal},
};

/// The number of points in a chunk, and the maximum number that a push copies of a log that a snapshot shares. The push that
/// fills a chunk also copies the table of the chunks before it.
const CHUNK_ROWS: usize = 64;

/// A table that points are only appended to; copies share its full chunks.
#[derive(Clone, Debug)]
pub(super) struct InsertionLog {
    full: Arc<Vec<Arc<Chunk>>>,
    last: Arc<Chunk>,
}

#[derive(Debug)]
struct Chunk {
    /// Ids, tags and revisions, without rows.
    labels: Points,
    rows: Blocks,
}

impl Chunk {
    fn with_room(width: usize, rows: usize) -> Self {
        Self {
            labels: Points::with_capacity(0, rows),
            rows: Blocks::with_capacity(width, rows),
        }
    }

    fn memory_bytes(&self) -> usize {
        self.labels.memory_bytes() + self.rows.memory_bytes()
    }
}

impl Clone for Chunk {
    fn clone(&self) -> Self {
        Self {
            labels: self.labels.copy_with_room(CHUNK_ROWS),
            rows: self.rows.copy_with_room(CHUNK_ROWS),
        }
    }
}

impl InsertionLog {
    pub(super) fn new(width: usize) -> Self {
        Self {
            full: Arc::default(),
            last: Arc::new(Chunk::with_room(width, 0)),
        }
    }

    pub(super) fn rows(&self) -> usize {
        self.full.len() * CHUNK_ROWS + self.last.labels.len()
    }

    pub(super) fn push(&mut self, point: PointRef<'_>) {
        let last = Arc::make_mut(&mut self.last);
        last.rows.write(last.labels.len(), point.row);
        last.labels.push_point(PointRef { row: &[], ..point });
        if last.labels.len() == CHUNK_ROWS {
            let empty = Chunk::with_room(point.row.len(), CHUNK_ROWS);
            let full = std::mem::replace(&mut self.last, Arc::new(empty));
            Arc::make_mut(&mut self.full).push(full);
        }
    }

    /// A copy of the point in `slot`.
    pub(super) fn get(&self, slot: usize) -> Point {
        let (chunk, at) = (self.chunk(slot), slot % CHUNK_ROWS);
        let label = chunk.labels.get(at);
        Point {
            row: chunk.rows.row(at).collect(),
            ..label.to_point()
        }
    }

    /// Appends a copy of the point in `slot` to `points`.
    pub(super) fn copy_to(&self, slot: usize, points: &mut Points) {
        let (chunk, at) = (self.chunk(slot), slot % CHUNK_ROWS);
        points.push_numbers(chunk.labels.get(at), chunk.rows.row(at));
    }

    fn chunk(&self, slot: usize) -> &Chunk {
        self.full.get(slot / CHUNK_ROWS).unwrap_or(&self.last)
    }

    /// Scans all visible points in memory order; each block counts as a leaf.
    #[inline(always)]
    pub(super) fn scan<'a, I: Isa>(
        &'a self,
        traversal: &mut Traversal<'a>,
        is_visible: impl Fn(usize) -> bool,
    ) {
        for (at, chunk) in self.full.iter().chain([&self.last]).enumerate() {
            let rows = chunk.labels.len();
            for start in (0..rows).step_by(BLOCK_ROWS) {
                if !traversal.enter_leaf() {
                    return;
                }
                let block = chunk.rows.block(start / BLOCK_ROWS);
                let lanes = (rows - start).min(BLOCK_ROWS);
                let slot = |lane| at * CHUNK_ROWS + start + lane;
                traversal.scan_block::<I>(block, lanes, self, slot, &is_visible);
            }
        }
    }

    pub(super) fn memory_bytes(&self) -> usize {
        let chunks = self.full.iter().chain([&self.last]);
        chunks.map(|chunk| chunk.memory_bytes()).sum()
    }
}

impl Labels for InsertionLog {
    fn id(&self, slot: usize) -> u64 {
        self.chunk(slot).labels.id(slot % CHUNK_ROWS)
    }

    fn tag(&self, slot: usize) -> u64 {
        self.chunk(slot).labels.tag(slot % CHUNK_ROWS)
    }

    fn revision(&self, slot: usize) -> u64 {
        self.chunk(slot).labels.revision(slot % CHUNK_ROWS)
    }
}
