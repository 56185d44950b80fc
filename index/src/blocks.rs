//! Rows coordinate by coordinate, side by side in blocks, as the kernels take them.

use crate::kernel::BLOCK;

/// A table of rows in blocks of [`BLOCK`]: the number of a row in a coordinate stands beside those of its neighbours.
/// Places that no row was written to hold zeros.
#[derive(Clone, Debug)]
pub(crate) struct Blocks {
    width: usize,
    columns: Vec<f64>,
}

impl Blocks {
    /// An empty table with room for `rows` rows of `width` numbers.
    pub(crate) fn with_capacity(width: usize, rows: usize) -> Self {
        Self {
            width,
            columns: Vec::with_capacity(rows.div_ceil(BLOCK) * width * BLOCK),
        }
    }

    /// Writes a row to a place, in one of the blocks that there are or in the next one.
    pub(crate) fn write(&mut self, place: usize, row: &[f64]) {
        let start = place / BLOCK * self.width * BLOCK;
        if start == self.columns.len() {
            self.columns.resize(start + self.width * BLOCK, 0.0);
        }
        let block = &mut self.columns[start..start + self.width * BLOCK];
        for (column, &x) in block.chunks_exact_mut(BLOCK).zip(row) {
            column[place % BLOCK] = x;
        }
    }

    /// The row in a place.
    pub(crate) fn row(&self, place: usize) -> impl Iterator<Item = f64> {
        let block = &self.block(place / BLOCK)[place % BLOCK..];
        block.iter().step_by(BLOCK).copied()
    }

    /// A block: of each coordinate `BLOCK` numbers.
    pub(crate) fn block(&self, at: usize) -> &[f64] {
        let width = self.width * BLOCK;
        &self.columns[at * width..][..width]
    }

    /// All blocks, one after the other.
    pub(crate) fn numbers(&self) -> &[f64] {
        &self.columns
    }

    /// A copy with room for `rows` rows in all.
    pub(crate) fn copy_with_room(&self, rows: usize) -> Self {
        let mut copy = Self::with_capacity(self.width, rows);
        copy.columns.extend_from_slice(&self.columns);
        copy
    }

    /// The bytes the columns hold.
    pub(crate) fn memory_bytes(&self) -> usize {
        8 * self.columns.capacity()
    }
}
