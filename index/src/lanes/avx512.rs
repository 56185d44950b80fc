//! Registers of 64 bytes, with every operation of `lanes` named. Otherwise the compiler cuts lanes into unequal parts
//! or, where the whole program is compiled for such processors (`-C target-cpu=native`), into registers of four,
//! and searches are slower.
#![expect(
    unsafe_code,
    reason = "the instructions are there, since only a task compiled for them names this set, and registers are loaded and \
              stored"
)]

use std::arch::x86_64::*;

use super::{
    isa::{Isa, Task},
    numbers::Operations,
};

/// The number of `f64` in a register; twice as many `f32` fit.
const WIDTH: usize = 8;

/// The set for registers of eight numbers. Private, so that only [`run`] names it.
struct Avx512;

/// True if this processor has the instructions that [`run`] is compiled for.
pub(super) fn is_available() -> bool {
    is_x86_feature_detected!("avx512f")
        && is_x86_feature_detected!("avx512vl")
        && is_x86_feature_detected!("avx512dq")
}

/// Runs a task compiled for AVX-512.
#[target_feature(enable = "avx512f,avx512vl,avx512dq")]
pub(super) fn run<T: Task>(task: T) -> T::Output {
    task.run::<Avx512>()
}

impl Isa for Avx512 {
    fn run<T: Task>(task: T) -> T::Output {
        // SAFETY: only the function of this name names this set, so the processor has the instructions.
        unsafe { run(task) }
    }

    /// Without a branch: the number of remaining lanes depends on the data, so a loop over them would be mispredicted.
    #[inline(always)]
    fn lowest<const N: usize>(keys: &[f64; N], lanes: u32) -> usize {
        const { assert!(N.is_multiple_of(WIDTH) && N <= 32) };
        // SAFETY: only `run` names this set, and there are `WIDTH` keys from each `at` on.
        unsafe {
            let mut lowest = _mm512_set1_pd(f64::INFINITY);
            for at in (0..N).step_by(WIDTH) {
                let keys = _mm512_loadu_pd(keys.as_ptr().add(at));
                lowest = _mm512_mask_min_pd(lowest, (lanes >> at) as u8, lowest, keys);
            }
            // Brings the lowest key into every lane: from the other half, the other quarter, the neighbour.
            let half = _mm512_shuffle_f64x2::<0b01_00_11_10>(lowest, lowest);
            lowest = _mm512_min_pd(lowest, half);
            let quarter = _mm512_shuffle_f64x2::<0b10_11_00_01>(lowest, lowest);
            lowest = _mm512_min_pd(lowest, quarter);
            let neighbour = _mm512_permute_pd::<0b0101_0101>(lowest);
            lowest = _mm512_min_pd(lowest, neighbour);
            let mut equal = 0;
            for at in (0..N).step_by(WIDTH) {
                let keys = _mm512_loadu_pd(keys.as_ptr().add(at));
                equal |= u32::from(_mm512_cmp_pd_mask::<_CMP_EQ_OQ>(keys, lowest)) << at;
            }
            (equal & lanes).trailing_zeros() as usize % N
        }
    }

    #[inline(always)]
    fn from_codes<const N: usize>(codes: &[u16; N]) -> [f32; N] {
        // SAFETY: only `run` names this set.
        unsafe { from_codes(codes) }
    }
}

/// Sixteen codes fill a register of numbers.
#[inline]
#[target_feature(enable = "avx512f")]
fn from_codes<const N: usize>(codes: &[u16; N]) -> [f32; N] {
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
            fn at_most<const N: usize>(keys: &[$type; N], limit: $type) -> u32 {
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
    div: _mm512_div_pd(x, y);
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
    div: _mm512_div_ps(x, y);
    max: _mm512_max_ps(x, y);
    min: _mm512_min_ps(x, y);
    abs: _mm512_abs_ps(x);
    sqrt: _mm512_sqrt_ps(x);
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The default loops.
    struct Plain;

    impl Operations<f64> for Plain {}
    impl Operations<f32> for Plain {}
    impl Isa for Plain {}

    /// The lane of the lowest key, for every set of lanes.
    struct LowestLanes([f64; 16]);

    impl Task for LowestLanes {
        type Output = Vec<usize>;

        #[inline(always)]
        fn run<I: Isa>(self) -> Self::Output {
            (1..1 << 16)
                .map(|lanes| I::lowest(&self.0, lanes))
                .collect()
        }
    }

    /// The results of all operations on two arrays, and the comparison with each number of the second.
    struct All<T>([T; 32], [T; 32]);

    macro_rules! all {
        ($type:ident) => {
            impl Task for All<$type> {
                type Output = (Vec<Vec<u64>>, Vec<u32>);

                #[inline(always)]
                fn run<I: Isa>(self) -> Self::Output {
                    let Self(x, y) = self;
                    // The sign of infinity minus itself is not specified.
                    let finite =
                        |lanes: [$type; 32]| lanes.map(|x| if x.is_nan() { 0.0 } else { x });
                    let results = [
                        finite(I::add(x, y)),
                        finite(I::sub(x, y)),
                        finite(I::mul(x, y)),
                        finite(I::div(x, y)),
                        I::max(x, y),
                        I::min(x, y),
                        I::abs(x),
                        I::sqrt(I::abs(x)),
                    ];
                    let bits = |lanes: [$type; 32]| lanes.map(|x| x.to_bits().into()).to_vec();
                    let within = y.iter().map(|&limit| I::at_most(&x, limit));
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
        fn run<I: Isa>(self) -> Vec<f32> {
            let codes: Vec<u16> = (0..=u16::MAX).collect();
            let lanes = codes
                .chunks_exact(32)
                .map(|codes| codes.first_chunk::<32>().unwrap());
            lanes.flat_map(I::from_codes).collect()
        }
    }

    #[test]
    fn codes_keep_their_values() {
        if !is_available() {
            return;
        }
        // SAFETY: `is_available` found the instructions in this processor.
        let wide = unsafe { run(Widened) };
        assert!(
            wide.iter()
                .zip(0..=u16::MAX)
                .all(|(&x, code)| x == f32::from(code))
        );
        assert_eq!(wide, Widened.run::<Plain>());
    }

    #[test]
    fn the_lowest_lane_is_the_one_a_loop_finds() {
        if !is_available() {
            return;
        }
        let few = [2.5, 1.0, f64::INFINITY, 0.0];
        for apart in [1, 3, 5, 7] {
            let keys =
                std::array::from_fn(|lane| few[lane * apart / 4 % 4] + (lane % apart) as f64);
            // SAFETY: `is_available` found the instructions in this processor.
            let wide = unsafe { run(LowestLanes(keys)) };
            assert_eq!(wide, LowestLanes(keys).run::<Plain>());
        }
        let one_by_one = LowestLanes([f64::INFINITY; 16]).run::<Plain>();
        assert!(
            one_by_one
                .iter()
                .zip(1u32..)
                .all(|(&lane, lanes)| lane == lanes.trailing_zeros() as usize)
        );
    }

    #[test]
    fn operations_equal_the_default_loops() {
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
            // SAFETY: `is_available` found the instructions in this processor.
            let wide = unsafe { (run(All(x, y)), run(All(halves.0, halves.1))) };
            let plain = All(x, y).run::<Plain>();
            assert_eq!(wide, (plain, All(halves.0, halves.1).run::<Plain>()));
        }
    }
}
