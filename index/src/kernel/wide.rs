//! The operations of `lanes` in registers of eight numbers, said by name. Left to itself, the compiler cuts lanes into
//! unequal parts or, where all of the program is compiled for such processors (`-C target-cpu=native`), into registers of
//! four: a search took up to 1.3 times as long.
#![expect(
    unsafe_code,
    reason = "the instructions are there, since only what is compiled for them names this set, and eight numbers are read \
              and written"
)]

use std::arch::x86_64::*;

use super::{
    compiled::{Set, Task},
    lanes::Operations,
};

/// The numbers of a register.
const WIDTH: usize = 8;

/// Processors with registers of eight numbers. Private, so that only [`run`] names it.
struct Avx512;

/// Whether this processor has what [`run`] is compiled for.
pub(super) fn is_available() -> bool {
    is_x86_feature_detected!("avx512f")
        && is_x86_feature_detected!("avx512vl")
        && is_x86_feature_detected!("avx512dq")
}

/// Runs a task compiled for them.
#[target_feature(enable = "avx512f,avx512vl,avx512dq")]
pub(super) fn run<T: Task>(task: T) -> T::Output {
    task.run::<Avx512>()
}

impl Set for Avx512 {
    #[inline(always)]
    fn within<const N: usize>(keys: &[f64; N], limit: f64) -> u32 {
        // SAFETY: only `run` names this set.
        unsafe { within(keys, limit) }
    }

    #[inline(always)]
    fn least<const N: usize>(keys: &[f64; N], left: u32) -> usize {
        // SAFETY: as above.
        unsafe { least(keys, left) }
    }
}

/// In registers alone, without a branch: how many bits are left, no processor foresees.
#[inline]
#[target_feature(enable = "avx512f")]
fn least<const N: usize>(keys: &[f64; N], left: u32) -> usize {
    const { assert!(N.is_multiple_of(WIDTH) && N <= 32) };
    let mut least = _mm512_set1_pd(f64::INFINITY);
    for at in (0..N).step_by(WIDTH) {
        // SAFETY: there are `WIDTH` keys from `at` on.
        let keys = unsafe { _mm512_loadu_pd(keys.as_ptr().add(at)) };
        least = _mm512_mask_min_pd(least, (left >> at) as u8, least, keys);
    }
    // The least in every lane: of the other half, of the other quarter, of the neighbour.
    least = _mm512_min_pd(least, _mm512_shuffle_f64x2::<0b01_00_11_10>(least, least));
    least = _mm512_min_pd(least, _mm512_shuffle_f64x2::<0b10_11_00_01>(least, least));
    least = _mm512_min_pd(least, _mm512_permute_pd::<0b0101_0101>(least));
    let mut equal = 0;
    for at in (0..N).step_by(WIDTH) {
        // SAFETY: as above.
        let keys = unsafe { _mm512_loadu_pd(keys.as_ptr().add(at)) };
        equal |= u32::from(_mm512_cmp_pd_mask::<_CMP_EQ_OQ>(keys, least)) << at;
    }
    (equal & left).trailing_zeros() as usize % N
}

#[inline]
#[target_feature(enable = "avx512f")]
fn within<const N: usize>(keys: &[f64; N], limit: f64) -> u32 {
    const { assert!(N.is_multiple_of(WIDTH) && N <= 32) };
    let limit = _mm512_set1_pd(limit);
    let mut mask = 0;
    for (at, keys) in keys.chunks_exact(WIDTH).enumerate() {
        // SAFETY: a chunk has `WIDTH` numbers.
        let keys = unsafe { _mm512_loadu_pd(keys.as_ptr()) };
        mask |= u32::from(_mm512_cmp_pd_mask::<_CMP_LE_OQ>(keys, limit)) << (WIDTH * at);
    }
    mask
}

macro_rules! instructions {
    ($($name:ident: $instruction:ident($x:ident $(, $y:ident)?);)*) => {
        impl Operations for Avx512 {
            $(
                #[inline(always)]
                fn $name<const N: usize>($x: [f64; N] $(, $y: [f64; N])?) -> [f64; N] {
                    const { assert!(N.is_multiple_of(WIDTH)) };
                    let mut out = $x;
                    for at in (0..N).step_by(WIDTH) {
                        // SAFETY: there are `WIDTH` numbers from `at` on, and only `run` names this set.
                        unsafe {
                            let $x = _mm512_loadu_pd($x.as_ptr().add(at));
                            $(let $y = _mm512_loadu_pd($y.as_ptr().add(at));)?
                            _mm512_storeu_pd(out.as_mut_ptr().add(at), $instruction($x $(, $y)?));
                        }
                    }
                    out
                }
            )*

            #[inline(always)]
            fn widen<const N: usize>(x: [f32; N]) -> [f64; N] {
                const { assert!(N.is_multiple_of(WIDTH)) };
                let mut out = [0.0; N];
                for at in (0..N).step_by(WIDTH) {
                    // SAFETY: there are `WIDTH` numbers from `at` on, and only `run` names this set.
                    unsafe {
                        let x = _mm256_loadu_ps(x.as_ptr().add(at));
                        _mm512_storeu_pd(out.as_mut_ptr().add(at), _mm512_cvtps_pd(x));
                    }
                }
                out
            }
        }
    };
}

instructions! {
    add: _mm512_add_pd(x, y);
    sub: _mm512_sub_pd(x, y);
    mul: _mm512_mul_pd(x, y);
    max: _mm512_max_pd(x, y);
    min: _mm512_min_pd(x, y);
    abs: _mm512_abs_pd(x);
    sqrt: _mm512_sqrt_pd(x);
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The loops.
    struct Plain;

    impl Operations for Plain {}

    impl Set for Plain {
        fn within<const N: usize>(_: &[f64; N], _: f64) -> u32 {
            unreachable!("not compared here")
        }
    }

    /// The lanes of the least keys, by each set of lanes.
    struct Leasts([f64; 16]);

    impl Task for Leasts {
        type Output = Vec<usize>;

        #[inline(always)]
        fn run<S: Set>(self) -> Self::Output {
            (1..1 << 16).map(|left| S::least(&self.0, left)).collect()
        }
    }

    /// What all operations make of two arrays, as bits.
    struct All([f64; 16], [f64; 16]);

    impl Task for All {
        type Output = [[u64; 16]; 8];

        #[inline(always)]
        fn run<S: Set>(self) -> Self::Output {
            let Self(x, y) = self;
            // Infinity less itself has no sign that anybody agreed on.
            let finite = |lanes: [f64; 16]| lanes.map(|x| if x.is_nan() { 0.0 } else { x });
            let results = [
                finite(S::add(x, y)),
                finite(S::sub(x, y)),
                finite(S::mul(x, y)),
                S::max(x, y),
                S::min(x, y),
                S::abs(x),
                S::sqrt(S::abs(x)),
                S::widen(x.map(|x| x as f32)),
            ];
            results.map(|lanes| lanes.map(f64::to_bits))
        }
    }

    #[test]
    fn the_least_is_what_a_loop_finds() {
        if !is_available() {
            return;
        }
        let few = [2.5, 1.0, f64::INFINITY, 0.0];
        for apart in [1, 3, 5, 7] {
            let keys =
                std::array::from_fn(|lane| few[lane * apart / 4 % 4] + (lane % apart) as f64);
            // SAFETY: the processor was asked for the instructions.
            let wide = unsafe { run(Leasts(keys)) };
            assert_eq!(wide, Leasts(keys).run::<Plain>());
        }
        let one_by_one = Leasts([f64::INFINITY; 16]).run::<Plain>();
        assert!(
            one_by_one
                .iter()
                .zip(1u32..)
                .all(|(&lane, left)| lane == left.trailing_zeros() as usize)
        );
    }

    #[test]
    fn lanes_are_what_loops_make_of_them() {
        if !is_available() {
            return;
        }
        let numbers = [
            0.0,
            -0.0,
            1.5,
            -2.25,
            1e150,
            -1e-300,
            f64::INFINITY,
            f64::NEG_INFINITY,
        ];
        for shift in 0..8 {
            let x: [f64; 16] = std::array::from_fn(|lane| numbers[lane % 8]);
            let y: [f64; 16] = std::array::from_fn(|lane| numbers[(lane + shift) % 8]);
            // SAFETY: the processor was asked for the instructions.
            let wide = unsafe { run(All(x, y)) };
            assert_eq!(wide, All(x, y).run::<Plain>());
        }
    }
}
