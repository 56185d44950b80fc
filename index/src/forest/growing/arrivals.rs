//! Points in the order in which they came.

use std::sync::Arc;

use crate::{
    PointRef, Points,
    blocks::Blocks,
    kernel::{BLOCK, Set},
    search::{Table, Walk},
};

/// Points of a chunk: what a push copies of a table that a snapshot shares is at most so much.
const CHUNK: usize = 64;

/// A table to which points are only added: full chunks are shared by count between its copies.
#[derive(Clone, Debug)]
pub(super) struct Arrivals {
    full: Arc<Vec<Arc<Chunk>>>,
    last: Arc<Chunk>,
}

/// Some points, and the same rows for search.
#[derive(Debug)]
struct Chunk {
    points: Points,
    blocks: Blocks,
}

impl Chunk {
    fn with_room(coordinates: usize, rows: usize) -> Self {
        Self {
            points: Points::with_capacity(coordinates, rows),
            blocks: Blocks::with_capacity(coordinates, rows),
        }
    }

    fn memory_bytes(&self) -> usize {
        self.points.memory_bytes() + self.blocks.memory_bytes()
    }
}

impl Clone for Chunk {
    fn clone(&self) -> Self {
        Self {
            points: self.points.copy_with_room(CHUNK),
            blocks: self.blocks.copy_with_room(CHUNK),
        }
    }
}

impl Arrivals {
    pub(super) fn new(coordinates: usize) -> Self {
        Self {
            full: Arc::default(),
            last: Arc::new(Chunk::with_room(coordinates, 0)),
        }
    }

    pub(super) fn rows(&self) -> usize {
        self.full.len() * CHUNK + self.last.points.len()
    }

    pub(super) fn push(&mut self, point: PointRef<'_>) {
        let last = Arc::make_mut(&mut self.last);
        last.blocks.write(last.points.len(), point.row);
        last.points.push_point(point);
        if last.points.len() == CHUNK {
            let empty = Chunk::with_room(last.points.coordinates(), CHUNK);
            let full = std::mem::replace(&mut self.last, Arc::new(empty));
            Arc::make_mut(&mut self.full).push(full);
        }
    }

    pub(super) fn get(&self, slot: usize) -> PointRef<'_> {
        self.chunk(slot).get(slot % CHUNK)
    }

    fn chunk(&self, slot: usize) -> &Points {
        let chunk = self.full.get(slot / CHUNK).unwrap_or(&self.last);
        &chunk.points
    }

    /// Shows `walk` all visible points, one after the other, each block as a leaf.
    #[inline(always)]
    pub(super) fn visit<'a, S: Set>(
        &'a self,
        walk: &mut Walk<'a>,
        visible: impl Fn(usize) -> bool,
    ) {
        for (at, chunk) in self.full.iter().chain([&self.last]).enumerate() {
            let rows = chunk.points.len();
            for start in (0..rows).step_by(BLOCK) {
                if !walk.enters_leaf() {
                    return;
                }
                let block = chunk.blocks.block(start / BLOCK);
                let slot = |lane| at * CHUNK + start + lane;
                walk.scan::<S>(block, (rows - start).min(BLOCK), self, slot, &visible);
            }
        }
    }

    pub(super) fn memory_bytes(&self) -> usize {
        let chunks = self.full.iter().chain([&self.last]);
        chunks.map(|chunk| chunk.memory_bytes()).sum()
    }
}

impl Table for Arrivals {
    fn id(&self, slot: usize) -> u64 {
        self.chunk(slot).id(slot % CHUNK)
    }

    fn tag(&self, slot: usize) -> u64 {
        self.chunk(slot).tag(slot % CHUNK)
    }

    fn revision(&self, slot: usize) -> u64 {
        self.chunk(slot).revision(slot % CHUNK)
    }
}
