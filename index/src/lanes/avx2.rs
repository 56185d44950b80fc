//! Registers of 32 bytes. The compiler uses them well by itself, except for comparisons.
#![expect(
    unsafe_code,
    reason = "the instructions are there, since only a task compiled for them names this set, and registers are loaded"
)]

use std::arch::x86_64::*;

use super::{
    isa::{Isa, Task},
    numbers::Operations,
};

/// The set for registers of four numbers. Private, so that only [`run`] names it.
struct Avx2;

/// Runs a task compiled for AVX2.
#[target_feature(enable = "avx2")]
pub(super) fn run<T: Task>(task: T) -> T::Output {
    task.run::<Avx2>()
}

impl Isa for Avx2 {
    fn run<T: Task>(task: T) -> T::Output {
        // SAFETY: only the function of this name names this set, so the processor has the instructions.
        unsafe { run(task) }
    }
}

macro_rules! comparison {
    ($type:ident x $width:literal, $load:ident, $set:ident, $compare:ident, $bits:ident) => {
        impl Operations<$type> for Avx2 {
            #[inline(always)]
            fn at_most<const N: usize>(keys: &[$type; N], limit: $type) -> u32 {
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
