//! The kernels, compiled once for each instruction set.
#![cfg_attr(
    target_arch = "x86_64",
    expect(
        unsafe_code,
        reason = "functions compiled for instructions that not every processor has: each is handed out only once the \
                  processor was asked for them, and makes a search several times as fast; and a prefetch, which makes \
                  one of a million points a tenth faster"
    )
)]

use super::{BLOCK, CHILDREN, Kernels, bound};
use crate::Space;

/// A bit for each key up to `limit`.
fn within(keys: &[f64], limit: f64) -> u32 {
    let mut mask = 0;
    for (lane, &key) in keys.iter().enumerate() {
        mask |= u32::from(key <= limit) << lane;
    }
    mask
}

/// A module with the kernels as compiled for the instruction set of these features.
macro_rules! compiled_for {
    ($set:ident, $within:path $(, $features:literal)?) => {
        mod $set {
            use super::{BLOCK, CHILDREN, Kernels, Space, bound};

            $(#[target_feature(enable = $features)])?
            fn boxes_inner(
                space: &Space,
                state: &[f64],
                ends: &[f64],
                limit: f64,
                keys: &mut [f64; CHILDREN],
            ) -> u32 {
                *keys = bound::keys(space, &bound::Boxes { state, ends }).0;
                $within(keys, limit)
            }

            $(#[target_feature(enable = $features)])?
            fn points_inner(
                space: &Space,
                state: &[f64],
                columns: &[f64],
                limit: f64,
                keys: &mut [f64; BLOCK],
            ) -> u32 {
                *keys = bound::keys(space, &bound::Points { state, columns }).0;
                $within(keys, limit)
            }

            #[allow(unused_unsafe, reason = "the portable kernels need no features")]
            pub(super) const KERNELS: Kernels = Kernels {
                name: stringify!($set),
                // SAFETY: `available` hands these out only where the processor has the features.
                boxes: |space, state, ends, limit, keys| unsafe { boxes_inner(space, state, ends, limit, keys) },
                // SAFETY: as above.
                points: |space, state, columns, limit, keys| unsafe {
                    points_inner(space, state, columns, limit, keys)
                },
            };
        }
    };
}

compiled_for!(portable, super::within);

#[cfg(target_arch = "x86_64")]
mod masks {
    //! `within` where there is an instruction for it, which the compiler does not find by itself.

    use std::arch::x86_64::*;

    #[target_feature(enable = "avx2")]
    pub(super) fn within_avx2(keys: &[f64], limit: f64) -> u32 {
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

    #[target_feature(enable = "avx512f")]
    pub(super) fn within_avx512(keys: &[f64], limit: f64) -> u32 {
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

#[cfg(target_arch = "x86_64")]
compiled_for!(avx2, super::masks::within_avx2, "avx2");
#[cfg(target_arch = "x86_64")]
compiled_for!(
    avx512,
    super::masks::within_avx512,
    "avx512f,avx512vl,avx512dq"
);

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
    let mut available = vec![portable::KERNELS];
    #[cfg(target_arch = "x86_64")]
    {
        if is_x86_feature_detected!("avx2") {
            available.push(avx2::KERNELS);
        }
        if is_x86_feature_detected!("avx512f")
            && is_x86_feature_detected!("avx512vl")
            && is_x86_feature_detected!("avx512dq")
        {
            available.push(avx512::KERNELS);
        }
    }
    available
}
