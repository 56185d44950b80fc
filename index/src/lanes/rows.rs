//! Blocks of rows, coordinate by coordinate, as lanes.

use super::{Isa, Lanes, Number, Operations};

/// The greatest number of children of a node: the lanes of a box kernel, two registers of eight. A search waits for one
/// node after another more than it computes, so it is slower with eight children.
pub(crate) const MAX_CHILDREN: usize = 16;

/// The number of points in a block: the lanes of a point kernel.
pub(crate) const BLOCK_ROWS: usize = 16;

/// The rows of a block of `N` points.
pub(crate) trait Rows<T: Number, const N: usize> {
    /// A number of a column.
    type Stored;

    /// Twice the maximum amount by which the cosine of two equal rotations is below 1.
    const CHORD_SLACK: f64;

    /// The numbers of one column.
    fn load<I: Isa + Operations<T>>(column: &[Self::Stored]) -> Lanes<I, T, N>;
}
