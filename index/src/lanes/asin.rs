//! The arcsine of numbers side by side, with the bits of `libm`'s.
//!
//! `libm` computes as FreeBSD and fdlibm do (`e_asin.c`): a rational function R approximates (asin x − x)/x³, for x
//! itself below ½, and for √((1 − x)/2) above it. Both ways are computed for every lane, by the same operations in the
//! same order, and one of them is kept. The coefficients are those of fdlibm:
//!
//! > Copyright (C) 1993 by Sun Microsystems, Inc. All rights reserved.
//! >
//! > Developed at SunSoft, a Sun Microsystems, Inc. business. Permission to use, copy, modify, and distribute this
//! > software is freely granted, provided that this notice is preserved.

use std::f64::consts::FRAC_PI_4;

use super::{isa::Isa, numbers::Lanes};

/// The coefficients of R's numerator, the highest first.
const NUMERATOR: [f64; 6] = [
    3.479_331_075_960_212e-5,
    7.915_349_942_898_145e-4,
    -4.005_553_450_067_941e-2,
    2.012_125_321_348_629_3e-1,
    -3.255_658_186_224_009e-1,
    1.666_666_666_666_666_6e-1,
];

/// The coefficients of R's denominator, the highest first; the last is that of the constant.
const DENOMINATOR: [f64; 5] = [
    7.703_815_055_590_194e-2,
    -6.882_839_716_054_533e-1,
    2.020_945_760_233_505_7,
    -2.403_394_911_734_414,
    1.0,
];

/// π/2 less its nearest `f64`.
const FRAC_PI_2_REST: f64 = 6.123_233_995_736_766e-17;

/// The arcsines of numbers from 0 to 0.9749, somewhat above which `libm` computes in another way.
#[inline(always)]
pub(crate) fn asin<I: Isa, const N: usize>(x: Lanes<I, f64, N>) -> Lanes<I, f64, N> {
    debug_assert!(x.0.iter().all(|x| (0.0..=0.9749).contains(x)));
    let [half, one, two] = [0.5, 1.0, 2.0].map(Lanes::splat);
    let of_rest = (one - x) * half;
    let z = Lanes::of(I::where_below(&x.0, 0.5, &(x * x).0, &of_rest.0));
    let ratio = z * polynomial(NUMERATOR, z) / polynomial(DENOMINATOR, z);
    let small = x + x * ratio;
    // The root in two parts, high + low.
    let root = z.sqrt();
    let high = Lanes::of(I::high_words(&root.0));
    let low = (z - high * high) / (root + high);
    let rest = two * root * ratio - (Lanes::splat(FRAC_PI_2_REST) - two * low);
    let quarter = Lanes::splat(FRAC_PI_4);
    let large = quarter - (rest - (quarter - two * high));
    Lanes::of(I::where_below(&x.0, 0.5, &small.0, &large.0))
}

/// The value at `z` of the polynomial with these coefficients, the highest first, by Horner's rule.
#[inline(always)]
fn polynomial<I: Isa, const N: usize, const M: usize>(
    coefficients: [f64; M],
    z: Lanes<I, f64, N>,
) -> Lanes<I, f64, N> {
    let mut value = Lanes::splat(coefficients[0]);
    for &coefficient in &coefficients[1..] {
        value = Lanes::splat(coefficient) + z * value;
    }
    value
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;
    use crate::lanes::{Kernels, Task};

    struct Asin([f64; 16]);

    impl Task for Asin {
        type Output = [f64; 16];

        #[inline(always)]
        fn run<I: Isa>(self) -> Self::Output {
            asin::<I, 16>(Lanes::of(self.0)).0
        }
    }

    #[test]
    fn each_bit_is_that_of_libm() {
        let mut rng = ChaCha8Rng::seed_from_u64(17);
        let edges = [0.0, 5e-324, 1e-310, 1e-200, 1.49e-8, 1.5e-8, 0.5, 0.974_8];
        let near = |x: f64, ulps: i64| f64::from_bits((x.to_bits() as i64 + ulps).max(0) as u64);
        for kernels in Kernels::available() {
            for round in 0..100_000 {
                let x: [f64; 16] = std::array::from_fn(|lane| match round % 3 {
                    0 => near(edges[lane % 8], rng.random_range(-40..40)),
                    1 => rng.random_range(0.0..0.974_9),
                    _ => 10_f64.powf(rng.random_range(-20.0..-0.02)),
                });
                let expected = x.map(|x| libm::asin(x).to_bits());
                assert_eq!(
                    kernels.run(Asin(x)).map(f64::to_bits),
                    expected,
                    "{}: {x:?}",
                    kernels.name()
                );
            }
        }
    }
}
