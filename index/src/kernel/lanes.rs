//! Numbers side by side: plain arrays with the operations that the kernels need, each of which becomes one instruction
//! a register in a function compiled for wide registers.

use std::{
    marker::PhantomData,
    ops::{Add, Mul, Sub},
};

macro_rules! operations {
    ($($name:ident: |$x:ident $(, $y:ident)?| $result:expr;)*) => {
        /// What can be done with numbers side by side: lane by lane, rounding as `f64` does.
        ///
        /// As loops, which the compiler turns into what the function around them is compiled for, unless an instruction
        /// set says its own.
        pub(crate) trait Operations {
            $(
                #[inline(always)]
                fn $name<const N: usize>(x: [f64; N] $(, $y: [f64; N])?) -> [f64; N] {
                    let mut out = x;
                    for lane in 0..N {
                        let $x = x[lane];
                        $(let $y = $y[lane];)?
                        out[lane] = $result;
                    }
                    out
                }
            )*

            /// The same numbers, twice as wide.
            #[inline(always)]
            fn widen<const N: usize>(x: [f32; N]) -> [f64; N] {
                x.map(f64::from)
            }
        }
    };
}

operations! {
    add: |x, y| x + y;
    sub: |x, y| x - y;
    mul: |x, y| x * y;
    max: |x, y| if x > y { x } else { y };
    min: |x, y| if x < y { x } else { y };
    abs: |x| x.abs();
    sqrt: |x| x.sqrt();
}

/// `N` numbers, and the instruction set that computes with them.
#[derive(Debug)]
#[repr(align(64))]
pub(crate) struct Lanes<S, const N: usize>(pub(crate) [f64; N], PhantomData<S>);

impl<S, const N: usize> Clone for Lanes<S, N> {
    #[inline(always)]
    fn clone(&self) -> Self {
        *self
    }
}

impl<S, const N: usize> Copy for Lanes<S, N> {}

impl<S: Operations, const N: usize> Lanes<S, N> {
    #[inline(always)]
    pub(crate) fn splat(x: f64) -> Self {
        Self([x; N], PhantomData)
    }

    /// The first `N` numbers of a column.
    #[inline(always)]
    pub(crate) fn load(column: &[f64]) -> Self {
        let column = column.first_chunk().expect("a column has N numbers");
        Self(*column, PhantomData)
    }

    /// The first `N` numbers of a rounded column.
    #[inline(always)]
    pub(crate) fn widen(column: &[f32]) -> Self {
        let column = column.first_chunk().expect("a column has N numbers");
        Self(S::widen(*column), PhantomData)
    }

    /// The greater; not `f64::max`, whose care for a NaN on either side takes three instructions instead of one.
    #[inline(always)]
    pub(crate) fn max(self, other: Self) -> Self {
        Self(S::max(self.0, other.0), PhantomData)
    }

    /// The smaller.
    #[inline(always)]
    pub(crate) fn min(self, other: Self) -> Self {
        Self(S::min(self.0, other.0), PhantomData)
    }

    #[inline(always)]
    pub(crate) fn abs(self) -> Self {
        Self(S::abs(self.0), PhantomData)
    }

    #[inline(always)]
    pub(crate) fn sqrt(self) -> Self {
        Self(S::sqrt(self.0), PhantomData)
    }
}

impl<S: Operations, const N: usize> Add for Lanes<S, N> {
    type Output = Self;

    #[inline(always)]
    fn add(self, other: Self) -> Self {
        Self(S::add(self.0, other.0), PhantomData)
    }
}

impl<S: Operations, const N: usize> Sub for Lanes<S, N> {
    type Output = Self;

    #[inline(always)]
    fn sub(self, other: Self) -> Self {
        Self(S::sub(self.0, other.0), PhantomData)
    }
}

impl<S: Operations, const N: usize> Mul for Lanes<S, N> {
    type Output = Self;

    #[inline(always)]
    fn mul(self, other: Self) -> Self {
        Self(S::mul(self.0, other.0), PhantomData)
    }
}
