//! The kernels of a search: bounds of many boxes or points at once, compiled for several instruction sets, of which the
//! best that the processor has is chosen when the program runs.
//!
//! Kernels only bound; what is reported was computed by [`Space::distance`], so every set of them gives the same
//! answers to the bit.

mod bound;
mod compiled;
mod lanes;
mod limit;
#[cfg(test)]
mod tests;
#[cfg(all(target_arch = "x86_64", target_feature = "avx512f"))]
mod wide;

use std::sync::OnceLock;

use crate::Space;
pub(crate) use bound::{BLOCK, CHILDREN};
pub(crate) use compiled::prefetch;
pub(crate) use limit::Scale;

/// Bounds `N` boxes or points: from the space, the state, their coordinates and a limit it makes their keys, and the
/// bits of those up to the limit.
type Kernel<const N: usize> = fn(&Space, &[f64], &[f64], f64, &mut [f64; N]) -> u32;

/// The kernels as compiled for one instruction set.
///
/// The best that the processor has is the default; others are for tests and measurements.
#[derive(Clone, Copy, Debug)]
pub struct Kernels {
    name: &'static str,
    /// Of a node's children, whose boxes' lower ends and then upper ends lie side by side, coordinate by coordinate.
    pub(crate) boxes: Kernel<CHILDREN>,
    /// Of a block of points, whose numbers lie side by side, coordinate by coordinate.
    pub(crate) points: Kernel<BLOCK>,
}

impl Kernels {
    /// The instruction set's name.
    pub fn name(&self) -> &'static str {
        self.name
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
