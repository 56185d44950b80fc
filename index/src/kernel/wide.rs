//! The operations of `lanes` in registers of 64 bytes, said by name. Left to itself, the compiler cuts lanes into
//! unequal parts or, where all of the program is compiled for such processors (`-C target-cpu=native`), into registers of
//! four: a search took up to 1.3 times as long.
#![expect(
    unsafe_code,
    reason = "the instructions are there, since only what is compiled for them names this set, and registers are read \
              and written"
)]

use std::arch::x86_64::*;

use super::{
    compiled::{Set, Task},
    lanes::Operations,
};

/// The `f64` of a register; of `f32` there are twice as many.
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
    fn least<const N: usize>(keys: &[f64; N], left: u32) -> usize {
        // SAFETY: only `run` names this set.
        unsafe { least(keys, left) }
    }

    #[inline(always)]
    fn widen<const N: usize>(codes: &[u16; N]) -> [f32; N] {
        // SAFETY: as above.
        unsafe { widen(codes) }
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

/// Sixteen codes a register of numbers.
#[inline]
#[target_feature(enable = "avx512f")]
fn widen<const N: usize>(codes: &[u16; N]) -> [f32; N] {
    const { assert!(N.is_multiple_of(2 * WIDTH)) };
    let mut numbers = [0.0; N];
    for at in (0..N).step_by(2 * WIDTH) {
        // SAFETY: there are sixteen codes and numbers from `at` on.
        unsafe {
            let codes = _mm512_cvtepu16_epi32(_mm256_loadu_si256(codes.as_ptr().add(at).cast()));
            _mm512_storeu_ps(numbers.as_mut_ptr().add(at), _mm512_cvtepi32_ps(codes));
        }
    }
    numbers
}

macro_rules! instructions {
    (
        $type:ident x $width:expr, $load:ident, $store:ident, $set:ident, $compare:ident;
        $($name:ident: $instruction:ident($x:ident $(, $y:ident)?);)*
    ) => {
        impl Operations<$type> for Avx512 {
            $(
                #[inline(always)]
                fn $name<const N: usize>($x: [$type; N] $(, $y: [$type; N])?) -> [$type; N] {
                    const { assert!(N.is_multiple_of($width)) };
                    let mut out = $x;
                    for at in (0..N).step_by($width) {
                        // SAFETY: there are `$width` numbers from `at` on, and only `run` names this set.
                        unsafe {
                            let $x = $load($x.as_ptr().add(at));
                            $(let $y = $load($y.as_ptr().add(at));)?
                            $store(out.as_mut_ptr().add(at), $instruction($x $(, $y)?));
                        }
                    }
                    out
                }
            )*

            #[inline(always)]
            fn within<const N: usize>(keys: &[$type; N], limit: $type) -> u32 {
                const { assert!(N.is_multiple_of($width) && N <= 32) };
                let mut mask = 0;
                for at in (0..N).step_by($width) {
                    // SAFETY: as above.
                    let bits = unsafe {
                        let keys = $load(keys.as_ptr().add(at));
                        $compare::<_CMP_LE_OQ>(keys, $set(limit))
                    };
                    mask |= u32::from(bits) << at;
                }
                mask
            }
        }
    };
}

instructions! {
    f64 x WIDTH, _mm512_loadu_pd, _mm512_storeu_pd, _mm512_set1_pd, _mm512_cmp_pd_mask;
    add: _mm512_add_pd(x, y);
    sub: _mm512_sub_pd(x, y);
    mul: _mm512_mul_pd(x, y);
    max: _mm512_max_pd(x, y);
    min: _mm512_min_pd(x, y);
    abs: _mm512_abs_pd(x);
    sqrt: _mm512_sqrt_pd(x);
}

instructions! {
    f32 x 2 * WIDTH, _mm512_loadu_ps, _mm512_storeu_ps, _mm512_set1_ps, _mm512_cmp_ps_mask;
    add: _mm512_add_ps(x, y);
    sub: _mm512_sub_ps(x, y);
    mul: _mm512_mul_ps(x, y);
    max: _mm512_max_ps(x, y);
    min: _mm512_min_ps(x, y);
    abs: _mm512_abs_ps(x);
    sqrt: _mm512_sqrt_ps(x);
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The loops.
    struct Plain;

    impl Operations<f64> for Plain {}
    impl Operations<f32> for Plain {}
    impl Set for Plain {}

    /// The lanes of the least keys, by each set of lanes.
    struct Leasts([f64; 16]);

    impl Task for Leasts {
        type Output = Vec<usize>;

        #[inline(always)]
        fn run<S: Set>(self) -> Self::Output {
            (1..1 << 16).map(|left| S::least(&self.0, left)).collect()
        }
    }

    /// What all operations make of two arrays, and the bits of what is up to each number of the second.
    struct All<T>([T; 32], [T; 32]);

    macro_rules! all {
        ($type:ident) => {
            impl Task for All<$type> {
                type Output = (Vec<Vec<u64>>, Vec<u32>);

                #[inline(always)]
                fn run<S: Set>(self) -> Self::Output {
                    let Self(x, y) = self;
                    // Infinity less itself has no sign that anybody agreed on.
                    let finite =
                        |lanes: [$type; 32]| lanes.map(|x| if x.is_nan() { 0.0 } else { x });
                    let results = [
                        finite(S::add(x, y)),
                        finite(S::sub(x, y)),
                        finite(S::mul(x, y)),
                        S::max(x, y),
                        S::min(x, y),
                        S::abs(x),
                        S::sqrt(S::abs(x)),
                    ];
                    let bits = |lanes: [$type; 32]| lanes.map(|x| x.to_bits().into()).to_vec();
                    let within = y.iter().map(|&limit| S::within(&x, limit));
                    (results.map(bits).to_vec(), within.collect())
                }
            }
        };
    }

    all!(f64);
    all!(f32);

    /// All codes as numbers.
    struct Widened;

    impl Task for Widened {
        type Output = Vec<f32>;

        #[inline(always)]
        fn run<S: Set>(self) -> Vec<f32> {
            let codes: Vec<u16> = (0..=u16::MAX).collect();
            let lanes = codes
                .chunks_exact(32)
                .map(|codes| codes.first_chunk::<32>().unwrap());
            lanes.flat_map(S::widen).collect()
        }
    }

    #[test]
    fn codes_are_the_numbers_that_they_are() {
        if !is_available() {
            return;
        }
        // SAFETY: the processor was asked for the instructions.
        let wide = unsafe { run(Widened) };
        assert!(
            wide.iter()
                .zip(0..=u16::MAX)
                .all(|(&x, code)| x == f32::from(code))
        );
        assert_eq!(wide, Widened.run::<Plain>());
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
            let x: [f64; 32] = std::array::from_fn(|lane| numbers[lane % 8]);
            let y: [f64; 32] = std::array::from_fn(|lane| numbers[(lane + shift) % 8]);
            let halves = (x.map(|x| x as f32), y.map(|y| y as f32));
            // SAFETY: the processor was asked for the instructions.
            let wide = unsafe { (run(All(x, y)), run(All(halves.0, halves.1))) };
            let plain = All(x, y).run::<Plain>();
            assert_eq!(wide, (plain, All(halves.0, halves.1).run::<Plain>()));
        }
    }
}
