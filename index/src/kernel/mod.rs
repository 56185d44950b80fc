//! The kernels of a search: bounds of many boxes or points at once, compiled for several instruction sets, of which the
//! best that the processor has is chosen when the program runs.
//!
//! A search as a whole is what is compiled several times, with its kernels inside: called as functions, they would take
//! long to be given their operands. Kernels only bound where a rotation weighs anything or numbers are rounded, and else
//! compute what [`Space::distance`] does by the same operations, so every set of them gives the same answers to the bit.

mod bound;
mod coded;
mod coding;
mod compiled;
mod lanes;
mod limit;
#[cfg(test)]
pub(crate) mod tests;
#[cfg(target_arch = "x86_64")]
mod wide;

use std::sync::OnceLock;

use crate::Space;
pub(crate) use bound::{BLOCK, CHILDREN};
pub(crate) use coded::{Asked, CODES};
pub(crate) use coding::Coding;
pub(crate) use compiled::{Set, Task, prefetch};
pub(crate) use limit::Scale;

/// The keys of a node's boxes, whose lower ends and then upper ends lie side by side, coordinate by coordinate, and the
/// bits of those up to `limit`.
#[inline(always)]
pub(crate) fn boxes<S: Set>(
    space: &Space,
    state: &[f64],
    ends: &[f64],
    limit: f64,
) -> ([f64; CHILDREN], u32) {
    let keys = bound::keys::<S, f64, _>(space, &bound::Boxes { state, ends }).0;
    (keys, S::within(&keys, limit))
}

/// The keys of a block of points, whose numbers lie side by side, coordinate by coordinate, and the bits of those up to
/// `limit`.
#[inline(always)]
pub(crate) fn points<S: Set>(
    space: &Space,
    state: &[f64],
    columns: &[f64],
    limit: f64,
) -> ([f64; BLOCK], u32) {
    let keys = bound::keys::<S, f64, _>(space, &bound::Points { state, columns }).0;
    (keys, S::within(&keys, limit))
}

/// The bits of the points of a block, whose codes lie side by side, coordinate by coordinate, that may have keys up to
/// `limit` once they have moved by [`Asked::error`].
#[inline(always)]
pub(crate) fn coded<S: Set>(space: &Space, asked: &Asked<'_>, codes: &[u16], limit: f64) -> u32 {
    let keys = bound::keys::<S, f32, _>(space, &coded::Coded { asked, codes }).0;
    S::within(&keys, asked.limit(limit))
}

/// The instruction set that a search is compiled for.
///
/// The best that the processor has is the default; others are for tests and measurements.
#[derive(Clone, Copy, Debug)]
pub struct Kernels {
    name: &'static str,
    set: compiled::Compiled,
}

impl Kernels {
    /// The instruction set's name.
    pub fn name(&self) -> &'static str {
        self.name
    }

    /// Whether they compute with wider registers than every processor has.
    pub(crate) fn are_wide(&self) -> bool {
        !matches!(self.set, compiled::Compiled::Portable)
    }

    /// All that this processor can run, the portable one first and the best one last.
    pub fn available() -> &'static [Kernels] {
        static AVAILABLE: OnceLock<Vec<Kernels>> = OnceLock::new();
        AVAILABLE.get_or_init(compiled::available)
    }
}

impl Default for Kernels {
    fn default() -> Self {
        *Self::available()
            .last()
            .expect("the portable kernels run everywhere")
    }
}
