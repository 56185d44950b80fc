//! The leaves of a growing tree.

use std::sync::Arc;

use crate::{
    boxes::extent,
    forest::tombstones::{LATEST, Tombstones},
    lanes::BLOCK_ROWS,
};

/// The id and the slot of a point in a leaf.
#[derive(Clone, Copy, Debug)]
pub(super) struct Label {
    pub(super) id: u64,
    /// The point's place in the insertion log.
    pub(super) slot: u32,
}

/// A few points near each other. Columns that a snapshot shares are copied before they change.
#[derive(Clone, Debug)]
pub(super) struct Leaf {
    rows: usize,
    /// The number of coordinates.
    width: usize,
    /// Blocks of points as the kernels read them, coordinate by coordinate. Each block has two more columns, with the
    /// bits of the ids and of the slots: one allocation for a leaf, since copies under a snapshot cost by the
    /// allocation.
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
            columns: vec![0.0; blocks * (width + 2) * BLOCK_ROWS].into(),
        }
    }

    pub(super) fn rows(&self) -> usize {
        self.rows
    }

    /// The blocks, all of them full but the last.
    pub(super) fn blocks(&self) -> impl Iterator<Item = LeafBlock<'_>> {
        let (rows, width) = (self.rows, self.width);
        let blocks = self.columns.chunks_exact((width + 2) * BLOCK_ROWS);
        let starts = (0..rows).step_by(BLOCK_ROWS);
        starts.zip(blocks).map(move |(start, block)| {
            let (columns, labels) = block.split_at(width * BLOCK_ROWS);
            LeafBlock {
                lanes: (rows - start).min(BLOCK_ROWS),
                columns,
                labels,
            }
        })
    }

    /// The numbers of the points in a coordinate, by block.
    pub(super) fn columns(&self, axis: usize) -> impl Iterator<Item = &[f64]> {
        self.blocks()
            .map(move |block| &block.columns[axis * BLOCK_ROWS..][..block.lanes])
    }

    /// The least and the greatest number of the points in a coordinate.
    pub(super) fn extent(&self, axis: usize) -> (f64, f64) {
        let extents = self.columns(axis).map(extent);
        extents.fold((f64::INFINITY, f64::NEG_INFINITY), |a, b| {
            (a.0.min(b.0), a.1.max(b.1))
        })
    }

    /// Adds a point.
    pub(super) fn push(&mut self, label: Label, row: impl Iterator<Item = f64>) {
        let block = (self.width + 2) * BLOCK_ROWS;
        let start = self.rows / BLOCK_ROWS * block;
        if start == self.columns.len() {
            let mut larger = Self::with_blocks(self.width, self.rows / BLOCK_ROWS + 1);
            Arc::make_mut(&mut larger.columns)[..start].copy_from_slice(&self.columns);
            self.columns = larger.columns;
        }
        let numbers = row.chain([label.id, label.slot.into()].map(f64::from_bits));
        let columns = &mut Arc::make_mut(&mut self.columns)[start..];
        for (column, x) in columns.chunks_exact_mut(BLOCK_ROWS).zip(numbers) {
            column[self.rows % BLOCK_ROWS] = x;
        }
        self.rows += 1;
    }

    /// Drops the points that are dead at the head; snapshots that see them have their own copies.
    pub(super) fn drop_dead(&mut self, tombstones: &Tombstones) {
        let is_alive = |label: Label| tombstones.is_visible(label.slot as usize, LATEST);
        let lanes = |block: LeafBlock<'_>| (0..block.lanes).all(|lane| is_alive(block.label(lane)));
        if tombstones.dead() == 0 || self.blocks().all(lanes) {
            return;
        }
        let mut kept = Self::new(self.width);
        for block in self.blocks() {
            for lane in (0..block.lanes).filter(|&lane| is_alive(block.label(lane))) {
                kept.push(block.label(lane), block.row(lane));
            }
        }
        *self = kept;
    }

    /// Two leaves: of the points whose number in the coordinate `axis` is below `at`, and of the others.
    pub(super) fn split(&self, axis: usize, at: f64) -> [Self; 2] {
        let mut halves = [Self::new(self.width), Self::new(self.width)];
        for block in self.blocks() {
            for lane in 0..block.lanes {
                let row = block.row(lane);
                let above = block.columns[axis * BLOCK_ROWS + lane] >= at;
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
    /// The number of its points.
    pub(super) lanes: usize,
    /// `BLOCK_ROWS` numbers for each coordinate.
    pub(super) columns: &'a [f64],
    labels: &'a [f64],
}

impl<'a> LeafBlock<'a> {
    pub(super) fn label(&self, lane: usize) -> Label {
        Label {
            id: self.labels[lane].to_bits(),
            slot: self.labels[BLOCK_ROWS + lane].to_bits() as u32,
        }
    }

    pub(super) fn row(&self, lane: usize) -> impl Iterator<Item = f64> + use<'a> {
        self.columns[lane..].iter().step_by(BLOCK_ROWS).copied()
    }
}
