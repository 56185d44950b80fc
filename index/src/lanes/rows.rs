//! Blocks of rows, coordinate by coordinate, as lanes.

use super::{Isa, Lanes, Number, Operations};

/// The greatest number of children of a node: the lanes of a box kernel, two registers of eight. A search waits for one
/// node after another more than it computes, so it is slower with eight children.
pub(crate) const MAX_CHILDREN: usize = 16;

/// The number of points in a block: the lanes of a point kernel.
pub(crate) const BLOCK_ROWS: usize = 16;

/// A block of `N` points, coordinate by coordinate, and the query in the same numbers.
pub(crate) trait Rows<T: Number, const N: usize> {
    /// A number of a column.
    type Stored;

    /// Twice the maximum amount by which the cosine of two equal rotations is below 1.
    const CHORD_SLACK: f64;

    /// The query's numbers.
    fn query(&self) -> &[T];
    /// The points' numbers: `N` for each coordinate.
    fn columns(&self) -> &[Self::Stored];
    /// The numbers of one column.
    fn load<I: Isa + Operations<T>>(column: &[Self::Stored]) -> Lanes<I, T, N>;
    /// A period in the unit of the numbers.
    fn period(period: f64) -> T;
    /// The part of the cosines in a factor of the space that is the same for all points: 0, except where quantised numbers count
    /// from a low.
    fn cosine_of_lows(&self, part_index: usize) -> T;
}
