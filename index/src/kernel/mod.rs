//! The kernels of a search: bounds of many boxes or points at once, compiled for several instruction sets. The best set
//! that the processor has is chosen when the program runs.
//!
//! A whole search is compiled once for each set, with its kernels inlined: calls would spend more on passing operands
//! than on the arithmetic. The kernels of boxes and points only bound a distance that includes a rotation or quantised
//! numbers; any other distance they compute by the operations of [`Space::distance`], and [`Measurement`] computes every
//! one so. So every set gives the same answers, to the bit.

mod asin;
#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
mod bound;
mod isa;
mod key;
mod lanes;
#[cfg(test)]
pub(crate) mod tests;

use std::sync::OnceLock;

use crate::Space;
pub(crate) use asin::asin;
pub(crate) use bound::{BLOCK_ROWS, MAX_CHILDREN, Rows, keys};
pub(crate) use isa::{Isa, Task, prefetch};
pub(crate) use key::KeyScale;
pub(crate) use lanes::{Lanes, Number, Operations};

/// The keys of the boxes of a node (see [`Boxes`](crate::boxes::Boxes)), and a bit for each key up to `limit`.
#[inline(always)]
pub(crate) fn boxes<I: Isa>(
    space: &Space,
    state: &[f64],
    ends: &[f64],
    limit: f64,
) -> ([f64; MAX_CHILDREN], u32) {
    let keys = keys::<I, f64, MAX_CHILDREN>(space, &bound::BoxTerms { state, ends }).0;
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

/// The instruction set that a search is compiled for.
///
/// The default is the best one that the processor has; the others are for tests and measurements.
#[derive(Clone, Copy, Debug)]
pub struct Kernels {
    name: &'static str,
    set: isa::InstructionSet,
}

impl Kernels {
    /// The name of the instruction set.
    pub fn name(&self) -> &'static str {
        self.name
    }

    /// True if its registers are wider than those that every processor has.
    pub(crate) fn are_wide(&self) -> bool {
        !matches!(self.set, isa::InstructionSet::Portable)
    }

    /// All sets that this processor can run, the portable one first and the best one last.
    pub fn available() -> &'static [Kernels] {
        static AVAILABLE: OnceLock<Vec<Kernels>> = OnceLock::new();
        AVAILABLE.get_or_init(isa::available)
    }
}

impl Default for Kernels {
    fn default() -> Self {
        *Self::available()
            .last()
            .expect("the portable kernels run everywhere")
    }
}
