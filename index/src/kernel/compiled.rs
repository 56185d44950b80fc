//! What is compiled once for each instruction set: whole searches, with the kernels inside them.
#![cfg_attr(
    target_arch = "x86_64",
    expect(
        unsafe_code,
        reason = "functions compiled for instructions that not every processor has: each is handed out only once the \
                  processor was asked for them, and makes a search several times as fast; and a prefetch, which makes \
                  one of a million points a tenth faster"
    )
)]

#[cfg(target_arch = "x86_64")]
use super::wide;
use super::{Kernels, lanes::Operations};

/// An instruction set: how it computes with numbers side by side, and compares them.
pub(crate) trait Set: Operations<f64> + Operations<f32> {
    /// Codes as numbers.
    #[inline(always)]
    fn widen<const N: usize>(codes: &[u16; N]) -> [f32; N] {
        // (Not `map`, of which a part would be compiled by itself, for the oldest processor.)
        let mut numbers = [0.0; N];
        for (number, &code) in numbers.iter_mut().zip(codes) {
            *number = f32::from(code);
        }
        numbers
    }

    /// The lane of the least of the keys that `left` has bits of, at least one; the first one if several are equal.
    #[inline(always)]
    fn least<const N: usize>(keys: &[f64; N], left: u32) -> usize {
        debug_assert_ne!(left, 0);
        let mut lane = left.trailing_zeros() as usize % N;
        let (mut least, mut left) = (keys[lane], left & (left - 1));
        while left != 0 {
            let other = left.trailing_zeros() as usize % N;
            left &= left - 1;
            let key = keys[other];
            lane = if key < least { other } else { lane };
            least = if key < least { key } else { least };
        }
        lane
    }
}

/// Work that is compiled once for each instruction set.
///
/// `run`, and all it calls that is to gain by that, must be `inline(always)`: what is called as a function of its own is
/// compiled for every processor.
pub(crate) trait Task {
    type Output;

    fn run<S: Set>(self) -> Self::Output;
}

/// The instruction sets that searches are compiled for.
#[derive(Clone, Copy, Debug)]
pub(super) enum Compiled {
    Portable,
    #[cfg(target_arch = "x86_64")]
    Avx2,
    #[cfg(target_arch = "x86_64")]
    Avx512,
}

impl Kernels {
    /// Runs what is compiled for these.
    #[inline]
    pub(crate) fn run<T: Task>(&self, task: T) -> T::Output {
        match self.set {
            Compiled::Portable => task.run::<Portable>(),
            // SAFETY: `available` hands these out only where the processor has the instructions.
            #[cfg(target_arch = "x86_64")]
            Compiled::Avx2 => unsafe { avx2::run(task) },
            // SAFETY: as above.
            #[cfg(target_arch = "x86_64")]
            Compiled::Avx512 => unsafe { wide::run(task) },
        }
    }
}

struct Portable;

impl Operations<f64> for Portable {}
impl Operations<f32> for Portable {}
impl Set for Portable {}

#[cfg(target_arch = "x86_64")]
mod avx2 {
    //! Processors with registers of four numbers, of which the compiler makes good use by itself, but for comparisons.

    use std::arch::x86_64::*;

    use super::{Operations, Set, Task};

    /// Private, so that only [`run`] names it.
    struct Avx2;

    /// Runs a task compiled for them.
    #[target_feature(enable = "avx2")]
    pub(super) fn run<T: Task>(task: T) -> T::Output {
        task.run::<Avx2>()
    }

    impl Set for Avx2 {}

    macro_rules! comparison {
        ($type:ident x $width:literal, $load:ident, $set:ident, $compare:ident, $bits:ident) => {
            impl Operations<$type> for Avx2 {
                #[inline(always)]
                fn within<const N: usize>(keys: &[$type; N], limit: $type) -> u32 {
                    const { assert!(N.is_multiple_of($width) && N <= 32) };
                    let mut mask = 0;
                    for (at, keys) in keys.chunks_exact($width).enumerate() {
                        // SAFETY: a chunk has `$width` numbers, and only `run` names this set.
                        let bits = unsafe {
                            let keys = $load(keys.as_ptr());
                            $bits($compare::<_CMP_LE_OQ>(keys, $set(limit)))
                        };
                        mask |= (bits as u32) << ($width * at);
                    }
                    mask
                }
            }
        };
    }

    comparison!(f64 x 4, _mm256_loadu_pd, _mm256_set1_pd, _mm256_cmp_pd, _mm256_movemask_pd);
    comparison!(f32 x 8, _mm256_loadu_ps, _mm256_set1_ps, _mm256_cmp_ps, _mm256_movemask_ps);
}

/// Asks for the beginning of `numbers` to be brought near, while something else is computed. Of what is longer, the
/// processor fetches the rest by itself once it is read in order.
#[inline]
pub(crate) fn prefetch<T>(numbers: &[T]) {
    #[cfg(target_arch = "x86_64")]
    for line in numbers.chunks(64 / size_of::<T>()).take(PREFETCH_LINES) {
        // SAFETY: a prefetch reads nothing that could be seen, and every x86-64 processor has it.
        unsafe {
            std::arch::x86_64::_mm_prefetch::<{ std::arch::x86_64::_MM_HINT_T0 }>(
                line.as_ptr().cast(),
            )
        };
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = numbers;
}

/// How many lines of 64 bytes are asked for.
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
        set: Compiled::Portable,
    }];
    #[cfg(target_arch = "x86_64")]
    {
        if is_x86_feature_detected!("avx2") {
            available.push(Kernels {
                name: "avx2",
                set: Compiled::Avx2,
            });
        }
        if wide::is_available() {
            available.push(Kernels {
                name: "avx512",
                set: Compiled::Avx512,
            });
        }
    }
    available
}
