//! Rows in blocks, with the numbers of one coordinate side by side, in the form that the kernels read.

use crate::{aligned::AlignedNumbers, lanes::BLOCK_ROWS};

/// A table of rows in blocks of [`BLOCK_ROWS`], coordinate by coordinate. An unwritten place holds zeros.
#[derive(Clone, Debug)]
pub(crate) struct Blocks {
    width: usize,
    columns: AlignedNumbers,
}

impl Blocks {
    /// An empty table with room for `rows` rows of `width` numbers.
    pub(crate) fn with_capacity(width: usize, rows: usize) -> Self {
        Self {
            width,
            columns: AlignedNumbers::with_capacity(Self::numbers_of(width, rows)),
        }
    }

    /// The numbers in the blocks of `rows` rows.
    fn numbers_of(width: usize, rows: usize) -> usize {
        rows.div_ceil(BLOCK_ROWS) * width * BLOCK_ROWS
    }

    /// Writes a row to a place of an existing block or of the next one.
    pub(crate) fn write(&mut self, place: usize, row: &[f64]) {
        let start = place / BLOCK_ROWS * self.width * BLOCK_ROWS;
        if start == self.columns.len() {
            self.columns.add_zeros(self.width * BLOCK_ROWS);
        }
        let block = &mut self.columns[start..start + self.width * BLOCK_ROWS];
        for (column, &x) in block.chunks_exact_mut(BLOCK_ROWS).zip(row) {
            column[place % BLOCK_ROWS] = x;
        }
    }

    /// The row in a place.
    pub(crate) fn row(&self, place: usize) -> impl Iterator<Item = f64> {
        let block = &self.block(place / BLOCK_ROWS)[place % BLOCK_ROWS..];
        // (Not `step_by`, whose length a table that takes the numbers does not trust.)
        (0..self.width).map(|axis| block[axis * BLOCK_ROWS])
    }

    /// The block at an index: `BLOCK_ROWS` numbers for each coordinate.
    pub(crate) fn block(&self, at: usize) -> &[f64] {
        let len = self.width * BLOCK_ROWS;
        &self.columns[at * len..][..len]
    }

    /// All blocks, one after the other.
    pub(crate) fn numbers(&self) -> &[f64] {
        &self.columns
    }

    /// A copy with room for `rows` rows in all.
    pub(crate) fn copy_with_room(&self, rows: usize) -> Self {
        Self {
            width: self.width,
            columns: (self.columns).copy_with_room(Self::numbers_of(self.width, rows)),
        }
    }

    /// The bytes that the columns hold.
    pub(crate) fn memory_bytes(&self) -> usize {
        self.columns.memory_bytes()
    }
}
