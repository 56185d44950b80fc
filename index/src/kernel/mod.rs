//! The kernels of a search: bounds of many boxes or points at once, as *keys*, which are ordered as distances are and
//! cost less (see [`KeyMap`]), and the distances of many points.
//!
//! The kernels of boxes and points only bound a distance that includes a rotation or quantised numbers; any other
//! distance they compute by the operations of [`Space::distance`], and [`Measurement`] computes every one so. So every
//! instruction set gives the same answers, to the bit.

mod bound;
mod key;
#[cfg(test)]
pub(crate) mod tests;

use crate::{
    Space,
    lanes::{BLOCK_ROWS, Isa, Lanes, MAX_CHILDREN, Task},
};
pub(crate) use bound::{FactorBounds, keys, point_bounds_2};
pub(crate) use key::KeyMap;

/// The keys of the boxes of a node (see [`Boxes`](crate::boxes::Boxes)), and a bit for each key up to `limit`.
#[inline(always)]
pub(crate) fn boxes<I: Isa>(
    space: &Space,
    state: &[f64],
    ends: &[f64],
    limit: f64,
) -> ([f64; MAX_CHILDREN], u32) {
    let keys = keys::<I, f64, MAX_CHILDREN>(space, &bound::BoxBounds { state, ends }).0;
    (keys, I::at_most(&keys, limit))
}

/// The keys of a block of points (see [`Blocks`](crate::blocks::Blocks)), and a bit for each key up to `limit`.
#[inline(always)]
pub(crate) fn points<I: Isa>(
    space: &Space,
    state: &[f64],
    columns: &[f64],
    limit: f64,
) -> ([f64; BLOCK_ROWS], u32) {
    let keys = keys::<I, f64, BLOCK_ROWS>(space, &bound::PointRows { state, columns }).0;
    (keys, I::at_most(&keys, limit))
}

/// Computes the distances of a block of points as [`Space::distance`] does.
pub(crate) struct Measurement<'a> {
    pub(crate) space: &'a Space,
    pub(crate) state: &'a [f64],
    pub(crate) columns: &'a [f64],
}

impl Task for Measurement<'_> {
    type Output = [f64; BLOCK_ROWS];

    #[inline(always)]
    fn run<I: Isa>(self) -> Self::Output {
        let (state, columns) = (self.state, self.columns);
        let rows = bound::MeasuredRows(bound::PointRows { state, columns });
        let sums = keys::<I, f64, BLOCK_ROWS>(self.space, &rows);
        match self.space.groups() {
            [group] => (Lanes::splat(group.weight) * sums.sqrt()).0,
            _ => sums.0,
        }
    }
}
