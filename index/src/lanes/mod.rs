//! Numbers side by side, compiled for several instruction sets. The best set that the processor has is chosen when the
//! program runs.
//!
//! A whole search is compiled once for each set, with its kernels inlined: calls would spend more on passing operands
//! than on the arithmetic.

mod asin;
#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
mod isa;
mod numbers;
mod rows;

use std::sync::OnceLock;

pub(crate) use asin::asin;
pub(crate) use isa::{Isa, Task, prefetch};
pub(crate) use numbers::{Lanes, Number, Operations};
pub(crate) use rows::{BLOCK_ROWS, MAX_CHILDREN, Rows};

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
