//! The leaves of a growing tree.

use std::sync::Arc;

use crate::{
    forest::tombstones::{HEAD, Tombstones},
    kernel::BLOCK,
};

/// What a leaf knows of a point besides its state.
#[derive(Clone, Copy, Debug)]
pub(super) struct Label {
    pub(super) id: u64,
    /// The point's place in the order in which points came.
    pub(super) slot: u32,
}

/// A few points that lie near each other. What a snapshot shares is copied before it changes.
#[derive(Clone, Debug)]
pub(super) struct Leaf {
    rows: usize,
    /// Numbers of a row.
    width: usize,
    /// Blocks of points, coordinate by coordinate, as the kernels take them; in each block two more columns, of the bits
    /// of ids and of slots. All in one piece, since what is copied under a snapshot is counted in pieces.
    columns: Arc<[f64]>,
}

impl Leaf {
    pub(super) fn new(width: usize) -> Self {
        Self::with_blocks(width, 1)
    }

    fn with_blocks(width: usize, blocks: usize) -> Self {
        Self {
            rows: 0,
            width,
            columns: vec![0.0; blocks * (width + 2) * BLOCK].into(),
        }
    }

    pub(super) fn rows(&self) -> usize {
        self.rows
    }

    /// Its blocks, each of `BLOCK` points, the last of what is left.
    pub(super) fn blocks(&self) -> impl Iterator<Item = LeafBlock<'_>> {
        let (rows, width) = (self.rows, self.width);
        let blocks = self.columns.chunks_exact((width + 2) * BLOCK);
        let starts = (0..rows).step_by(BLOCK);
        starts.zip(blocks).map(move |(start, block)| {
            let (columns, labels) = block.split_at(width * BLOCK);
            LeafBlock {
                lanes: (rows - start).min(BLOCK),
                columns,
                labels,
            }
        })
    }

    /// The numbers of its points in a coordinate.
    pub(super) fn column(&self, axis: usize) -> impl Iterator<Item = f64> {
        self.blocks().flat_map(move |block| block.column(axis))
    }

    /// Adds a point, `row` its numbers.
    pub(super) fn push(&mut self, label: Label, row: impl Iterator<Item = f64>) {
        let block = (self.width + 2) * BLOCK;
        let start = self.rows / BLOCK * block;
        if start == self.columns.len() {
            let mut larger = Self::with_blocks(self.width, self.rows / BLOCK + 1);
            Arc::make_mut(&mut larger.columns)[..start].copy_from_slice(&self.columns);
            self.columns = larger.columns;
        }
        let numbers = row.chain([label.id, label.slot.into()].map(f64::from_bits));
        let columns = &mut Arc::make_mut(&mut self.columns)[start..];
        for (column, x) in columns.chunks_exact_mut(BLOCK).zip(numbers) {
            column[self.rows % BLOCK] = x;
        }
        self.rows += 1;
    }

    /// Lets go of the points that are dead at the head; snapshots that see them have copies of their own.
    pub(super) fn forget(&mut self, tombstones: &Tombstones) {
        let lives = |label: Label| tombstones.sees(label.slot as usize, HEAD);
        let lanes = |block: LeafBlock<'_>| (0..block.lanes).all(|lane| lives(block.label(lane)));
        if tombstones.dead() == 0 || self.blocks().all(lanes) {
            return;
        }
        let mut kept = Self::new(self.width);
        for block in self.blocks() {
            for lane in (0..block.lanes).filter(|&lane| lives(block.label(lane))) {
                kept.push(block.label(lane), block.row(lane));
            }
        }
        *self = kept;
    }

    /// Two leaves: the points whose number in the coordinate `axis` lies below `at`, and the others.
    pub(super) fn split(&self, axis: usize, at: f64) -> [Self; 2] {
        let mut halves = [Self::new(self.width), Self::new(self.width)];
        for block in self.blocks() {
            for lane in 0..block.lanes {
                let row = block.row(lane);
                let above = block.columns[axis * BLOCK + lane] >= at;
                halves[usize::from(above)].push(block.label(lane), row);
            }
        }
        halves
    }

    pub(super) fn memory_bytes(&self) -> usize {
        size_of_val(&*self.columns)
    }
}

/// A block of a leaf.
#[derive(Clone, Copy)]
pub(super) struct LeafBlock<'a> {
    /// How many points it has.
    pub(super) lanes: usize,
    /// Of each coordinate `BLOCK` numbers.
    pub(super) columns: &'a [f64],
    labels: &'a [f64],
}

impl<'a> LeafBlock<'a> {
    pub(super) fn label(&self, lane: usize) -> Label {
        Label {
            id: self.labels[lane].to_bits(),
            slot: self.labels[BLOCK + lane].to_bits() as u32,
        }
    }

    fn column(&self, axis: usize) -> impl Iterator<Item = f64> + use<'a> {
        self.columns[axis * BLOCK..][..self.lanes].iter().copied()
    }

    pub(super) fn row(&self, lane: usize) -> impl Iterator<Item = f64> + use<'a> {
        self.columns[lane..].iter().step_by(BLOCK).copied()
    }
}
