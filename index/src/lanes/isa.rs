//! Dispatch: a task is compiled once for each instruction set, and run by the one that the caller chose.
#![cfg_attr(
    target_arch = "x86_64",
    expect(
        unsafe_code,
        reason = "calls of functions compiled for instructions that not every processor has, which make a search several \
                  times as fast and are handed out only after the processor was asked for them; and a prefetch, which \
                  makes a search of a million points a tenth faster"
    )
)]

use super::{Kernels, numbers::Operations};
#[cfg(target_arch = "x86_64")]
use super::{avx2, avx512};

/// An instruction set: operations on numbers side by side.
pub(crate) trait Isa: Operations<f64> + Operations<f32> {
    /// 16-bit codes as numbers.
    #[inline(always)]
    fn from_codes<const N: usize>(codes: &[u16; N]) -> [f32; N] {
        // (`map` is not used, because a part of it would be compiled separately, for the oldest processor.)
        let mut numbers = [0.0; N];
        for (number, &code) in numbers.iter_mut().zip(codes) {
            *number = f32::from(code);
        }
        numbers
    }

    /// Runs a task compiled for this set, from code that is not: a call, where inlining the task would make the rest of
    /// a search slower.
    fn run<T: Task>(task: T) -> T::Output
    where
        Self: Sized,
    {
        task.run::<Self>()
    }

    /// In each lane `below` if `x` is below the bound, otherwise `other`.
    #[inline(always)]
    fn where_below<const N: usize>(
        x: &[f64; N],
        bound: f64,
        below: &[f64; N],
        other: &[f64; N],
    ) -> [f64; N] {
        let mut chosen = *other;
        for lane in 0..N {
            chosen[lane] = if x[lane] < bound {
                below[lane]
            } else {
                other[lane]
            };
        }
        chosen
    }

    /// The numbers without the lower half of their bits.
    #[inline(always)]
    fn high_words<const N: usize>(x: &[f64; N]) -> [f64; N] {
        let mut high = *x;
        for number in &mut high {
            *number = f64::from_bits(number.to_bits() & !0 << 32);
        }
        high
    }

    /// The lane of the lowest key among those with a bit in `lanes`, at least one; the first of several equal ones.
    #[inline(always)]
    fn lowest<const N: usize>(keys: &[f64; N], lanes: u32) -> usize {
        debug_assert_ne!(lanes, 0);
        let mut lane = lanes.trailing_zeros() as usize % N;
        let (mut lowest, mut lanes) = (keys[lane], lanes & (lanes - 1));
        while lanes != 0 {
            let other = lanes.trailing_zeros() as usize % N;
            lanes &= lanes - 1;
            let key = keys[other];
            lane = if key < lowest { other } else { lane };
            lowest = if key < lowest { key } else { lowest };
        }
        lane
    }
}

/// Work that is compiled once for each instruction set.
///
/// `run`, and all that it calls and that should gain by that, must be `inline(always)`: a function that is called is
/// compiled for every processor.
pub(crate) trait Task {
    type Output;

    fn run<I: Isa>(self) -> Self::Output;
}

/// The instruction sets that searches are compiled for.
#[derive(Clone, Copy, Debug)]
pub(super) enum InstructionSet {
    Portable,
    #[cfg(target_arch = "x86_64")]
    Avx2,
    #[cfg(target_arch = "x86_64")]
    Avx512,
}

impl Kernels {
    /// Runs a task with these kernels.
    #[inline]
    pub(crate) fn run<T: Task>(&self, task: T) -> T::Output {
        match self.set {
            InstructionSet::Portable => task.run::<Portable>(),
            // SAFETY: `available` hands these out only where the processor has the instructions.
            #[cfg(target_arch = "x86_64")]
            InstructionSet::Avx2 => unsafe { avx2::run(task) },
            // SAFETY: as above.
            #[cfg(target_arch = "x86_64")]
            InstructionSet::Avx512 => unsafe { avx512::run(task) },
        }
    }
}

struct Portable;

impl Operations<f64> for Portable {}
impl Operations<f32> for Portable {}
impl Isa for Portable {}

/// Fetches the beginning of `numbers` into the cache. The processor fetches the rest by itself once it is read in
/// order.
#[inline]
pub(crate) fn prefetch<T>(numbers: &[T]) {
    #[cfg(target_arch = "x86_64")]
    for line in numbers.chunks(64 / size_of::<T>()).take(PREFETCH_LINES) {
        // SAFETY: a prefetch has no effect on memory, and every x86-64 processor has it.
        unsafe {
            std::arch::x86_64::_mm_prefetch::<{ std::arch::x86_64::_MM_HINT_T0 }>(
                line.as_ptr().cast(),
            )
        };
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = numbers;
}

/// The number of cache lines fetched, of 64 bytes each.
#[cfg(target_arch = "x86_64")]
const PREFETCH_LINES: usize = 16;

/// The kernels that this processor can run, the best last.
pub(super) fn available() -> Vec<Kernels> {
    #[cfg_attr(
        not(target_arch = "x86_64"),
        expect(unused_mut, reason = "only x86-64 has others")
    )]
    let mut available = vec![Kernels {
        name: "portable",
        set: InstructionSet::Portable,
    }];
    #[cfg(target_arch = "x86_64")]
    {
        if is_x86_feature_detected!("avx2") {
            available.push(Kernels {
                name: "avx2",
                set: InstructionSet::Avx2,
            });
        }
        if avx512::is_available() {
            available.push(Kernels {
                name: "avx512",
                set: InstructionSet::Avx512,
            });
        }
    }
    available
}
