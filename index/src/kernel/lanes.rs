//! Numbers side by side: plain arrays with the operations that the kernels need, each of which becomes one instruction
//! a register in a function compiled for wide registers.

use std::ops::{Add, Mul, Sub};

#[cfg(not(all(target_arch = "x86_64", target_feature = "avx512f")))]
use self::plain as by_lane;
#[cfg(all(target_arch = "x86_64", target_feature = "avx512f"))]
use super::wide as by_lane;

/// `N` numbers. All operations are lane by lane, and round as `f64` does.
#[derive(Clone, Copy, Debug)]
#[repr(align(64))]
pub(crate) struct Lanes<const N: usize>(pub(crate) [f64; N]);

impl<const N: usize> Lanes<N> {
    #[inline(always)]
    pub(crate) fn splat(x: f64) -> Self {
        Self([x; N])
    }

    /// The first `N` numbers of a column.
    #[inline(always)]
    pub(crate) fn load(column: &[f64]) -> Self {
        Self(*column.first_chunk().expect("a column has N numbers"))
    }

    /// The greater; not `f64::max`, whose care for a NaN on either side takes three instructions instead of one.
    #[inline(always)]
    pub(crate) fn max(self, other: Self) -> Self {
        Self(by_lane::max(self.0, other.0))
    }

    /// The smaller.
    #[inline(always)]
    pub(crate) fn min(self, other: Self) -> Self {
        Self(by_lane::min(self.0, other.0))
    }

    #[inline(always)]
    pub(crate) fn abs(self) -> Self {
        Self(by_lane::abs(self.0))
    }

    #[inline(always)]
    pub(crate) fn sqrt(self) -> Self {
        Self(by_lane::sqrt(self.0))
    }
}

impl<const N: usize> Add for Lanes<N> {
    type Output = Self;

    #[inline(always)]
    fn add(self, other: Self) -> Self {
        Self(by_lane::add(self.0, other.0))
    }
}

impl<const N: usize> Sub for Lanes<N> {
    type Output = Self;

    #[inline(always)]
    fn sub(self, other: Self) -> Self {
        Self(by_lane::sub(self.0, other.0))
    }
}

impl<const N: usize> Mul for Lanes<N> {
    type Output = Self;

    #[inline(always)]
    fn mul(self, other: Self) -> Self {
        Self(by_lane::mul(self.0, other.0))
    }
}

/// The operations as loops, which the compiler turns into what the function around them is compiled for.
#[cfg_attr(
    all(target_arch = "x86_64", target_feature = "avx512f", not(test)),
    expect(dead_code, reason = "`wide` takes its place")
)]
pub(super) mod plain {
    macro_rules! loops {
        ($($name:ident: |$x:ident $(, $y:ident)?| $result:expr;)*) => {
            $(#[inline(always)]
            pub(crate) fn $name<const N: usize>(x: [f64; N] $(, $y: [f64; N])?) -> [f64; N] {
                let mut out = x;
                for lane in 0..N {
                    let $x = x[lane];
                    $(let $y = $y[lane];)?
                    out[lane] = $result;
                }
                out
            })*
        };
    }

    loops! {
        add: |x, y| x + y;
        sub: |x, y| x - y;
        mul: |x, y| x * y;
        max: |x, y| if x > y { x } else { y };
        min: |x, y| if x < y { x } else { y };
        abs: |x| x.abs();
        sqrt: |x| x.sqrt();
    }
}
