//! Rows as one asks for them, number after number, made from the blocks that searches read.

use std::sync::{
    OnceLock,
    atomic::{AtomicUsize, Ordering::Relaxed},
};

/// The rows of the blocks that were asked for a point, from then on: few, where planners search much and look up
/// little. To keep those of all blocks would take as much memory again as the blocks.
#[derive(Clone, Debug, Default)]
pub(super) struct Rows {
    blocks: Box<[OnceLock<Box<[f64]>>]>,
    numbers: Count,
}

impl Rows {
    pub(super) fn new(blocks: usize) -> Self {
        Self {
            blocks: (0..blocks).map(|_| OnceLock::new()).collect(),
            numbers: Count::default(),
        }
    }

    /// The rows of a block, one after the other, made by `make` when they are first asked for.
    pub(super) fn of_block(&self, block: usize, make: impl FnOnce() -> Box<[f64]>) -> &[f64] {
        self.blocks[block].get_or_init(|| {
            let rows = make();
            self.numbers.0.fetch_add(rows.len(), Relaxed);
            rows
        })
    }

    /// The bytes they hold by now.
    pub(super) fn memory_bytes(&self) -> usize {
        size_of_val(&*self.blocks) + 8 * self.numbers.0.load(Relaxed)
    }
}

/// How many numbers the rows have that were made.
#[derive(Debug, Default)]
struct Count(AtomicUsize);

impl Clone for Count {
    fn clone(&self) -> Self {
        Self(self.0.load(Relaxed).into())
    }
}
