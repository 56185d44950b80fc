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

use super::Kernels;

/// An instruction set: the one operation that the compiler does not make of a loop by itself.
pub(crate) trait Set {
    /// A bit for each key up to `limit`. There are eight keys, or a multiple of that.
    fn within(keys: &[f64], limit: f64) -> u32;
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
            Compiled::Avx2 => unsafe { x86::run_avx2(task) },
            // SAFETY: as above.
            #[cfg(target_arch = "x86_64")]
            Compiled::Avx512 => unsafe { x86::run_avx512(task) },
        }
    }
}

struct Portable;

impl Set for Portable {
    #[inline(always)]
    fn within(keys: &[f64], limit: f64) -> u32 {
        let mut mask = 0;
        for (lane, &key) in keys.iter().enumerate() {
            mask |= u32::from(key <= limit) << lane;
        }
        mask
    }
}

#[cfg(target_arch = "x86_64")]
mod x86 {
    use std::arch::x86_64::*;

    use super::{Set, Task};

    struct Avx2;
    struct Avx512;

    impl Set for Avx2 {
        #[inline(always)]
        fn within(keys: &[f64], limit: f64) -> u32 {
            // SAFETY: only `run_avx2` names this set.
            unsafe { within_avx2(keys, limit) }
        }
    }

    impl Set for Avx512 {
        #[inline(always)]
        fn within(keys: &[f64], limit: f64) -> u32 {
            // SAFETY: only `run_avx512` names this set.
            unsafe { within_avx512(keys, limit) }
        }
    }

    #[target_feature(enable = "avx2")]
    pub(super) fn run_avx2<T: Task>(task: T) -> T::Output {
        task.run::<Avx2>()
    }

    #[target_feature(enable = "avx512f,avx512vl,avx512dq")]
    pub(super) fn run_avx512<T: Task>(task: T) -> T::Output {
        task.run::<Avx512>()
    }

    #[inline]
    #[target_feature(enable = "avx2")]
    fn within_avx2(keys: &[f64], limit: f64) -> u32 {
        let limit = _mm256_set1_pd(limit);
        let mut mask = 0;
        for (at, keys) in keys.chunks_exact(4).enumerate() {
            // SAFETY: a chunk has four numbers.
            let keys = unsafe { _mm256_loadu_pd(keys.as_ptr()) };
            let bits = _mm256_movemask_pd(_mm256_cmp_pd::<_CMP_LE_OQ>(keys, limit));
            mask |= (bits as u32) << (4 * at);
        }
        mask
    }

    #[inline]
    #[target_feature(enable = "avx512f")]
    fn within_avx512(keys: &[f64], limit: f64) -> u32 {
        let limit = _mm512_set1_pd(limit);
        let mut mask = 0;
        for (at, keys) in keys.chunks_exact(8).enumerate() {
            // SAFETY: a chunk has eight numbers.
            let keys = unsafe { _mm512_loadu_pd(keys.as_ptr()) };
            mask |= u32::from(_mm512_cmp_pd_mask::<_CMP_LE_OQ>(keys, limit)) << (8 * at);
        }
        mask
    }
}

/// Asks for the beginning of `numbers` to be brought near, while something else is computed. Of what is longer, the
/// processor fetches the rest by itself once it is read in order.
#[inline]
pub(crate) fn prefetch(numbers: &[f64]) {
    #[cfg(target_arch = "x86_64")]
    for line in numbers.chunks(8).take(PREFETCH_LINES) {
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

/// How many lines of eight numbers are asked for.
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
        if is_x86_feature_detected!("avx512f")
            && is_x86_feature_detected!("avx512vl")
            && is_x86_feature_detected!("avx512dq")
        {
            available.push(Kernels {
                name: "avx512",
                set: Compiled::Avx512,
            });
        }
    }
    available
}
