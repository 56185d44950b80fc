//! The operations of `lanes` in registers of eight numbers, where all of the program is compiled for processors that have
//! them (`-C target-cpu=native`). Left to itself, the compiler takes such processors to be better off with registers of
//! four: for these kernels they are not, a search took up to 1.3 times as long.
#![expect(
    unsafe_code,
    reason = "the instructions are there, since the program is compiled for them, and eight numbers are read and written"
)]

use std::arch::x86_64::*;

/// The numbers of a register.
const WIDTH: usize = 8;

macro_rules! instructions {
    ($($name:ident: $instruction:ident($x:ident $(, $y:ident)?);)*) => {
        $(#[inline(always)]
        pub(crate) fn $name<const N: usize>($x: [f64; N] $(, $y: [f64; N])?) -> [f64; N] {
            const { assert!(N.is_multiple_of(WIDTH)) };
            let mut out = $x;
            for at in (0..N).step_by(WIDTH) {
                // SAFETY: there are `WIDTH` numbers from `at` on, and this module is compiled only for processors that
                // have the instructions.
                unsafe {
                    let $x = _mm512_loadu_pd($x.as_ptr().add(at));
                    $(let $y = _mm512_loadu_pd($y.as_ptr().add(at));)?
                    _mm512_storeu_pd(out.as_mut_ptr().add(at), $instruction($x $(, $y)?));
                }
            }
            out
        })*
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
    use crate::kernel::lanes::plain;

    #[test]
    fn lanes_are_what_loops_make_of_them() {
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
        let bits = |lanes: [f64; 16]| lanes.map(f64::to_bits);
        for shift in 0..8 {
            let x: [f64; 16] = std::array::from_fn(|lane| numbers[lane % 8]);
            let y: [f64; 16] = std::array::from_fn(|lane| numbers[(lane + shift) % 8]);
            // Infinity less itself has no sign that anybody agreed on.
            let finite = |lanes: [f64; 16]| lanes.map(|x| if x.is_nan() { 0.0 } else { x });
            assert_eq!(bits(finite(add(x, y))), bits(finite(plain::add(x, y))));
            assert_eq!(bits(finite(sub(x, y))), bits(finite(plain::sub(x, y))));
            assert_eq!(bits(finite(mul(x, y))), bits(finite(plain::mul(x, y))));
            assert_eq!(bits(max(x, y)), bits(plain::max(x, y)));
            assert_eq!(bits(min(x, y)), bits(plain::min(x, y)));
            assert_eq!(bits(abs(x)), bits(plain::abs(x)));
            assert_eq!(bits(sqrt(abs(x))), bits(plain::sqrt(plain::abs(x))));
        }
    }
}
