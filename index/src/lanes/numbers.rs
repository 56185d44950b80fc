//! Numbers side by side: plain arrays with the operations that the kernels need. In a function compiled for wide
//! registers each operation is one instruction for a register.

use std::{
    marker::PhantomData,
    ops::{Add, Div, Mul, Sub},
};

/// The type of the numbers: `f64`, or `f32` for quantised rows.
pub(crate) trait Number:
    Copy
    + PartialOrd
    + Add<Output = Self>
    + Sub<Output = Self>
    + Mul<Output = Self>
    + Div<Output = Self>
{
    /// The number nearest to `x`.
    fn near(x: f64) -> Self;
    fn abs(self) -> Self;
    fn sqrt(self) -> Self;
}

macro_rules! number {
    ($type:ident) => {
        impl Number for $type {
            #[inline(always)]
            fn near(x: f64) -> Self {
                x as $type
            }

            #[inline(always)]
            fn abs(self) -> Self {
                $type::abs(self)
            }

            #[inline(always)]
            fn sqrt(self) -> Self {
                $type::sqrt(self)
            }
        }
    };
}

number!(f64);
number!(f32);

macro_rules! operations {
    ($($name:ident: |$x:ident $(, $y:ident)?| $result:expr;)*) => {
        /// Operations on numbers side by side, lane by lane, rounding as their type does.
        ///
        /// The defaults are loops, which the compiler turns into the instructions that the function around them is
        /// compiled for. An instruction set may name its own.
        pub(crate) trait Operations<T: Number> {
            $(
                #[inline(always)]
                fn $name<const N: usize>(x: [T; N] $(, $y: [T; N])?) -> [T; N] {
                    let mut out = x;
                    for lane in 0..N {
                        let $x = x[lane];
                        $(let $y = $y[lane];)?
                        out[lane] = $result;
                    }
                    out
                }
            )*

            /// A bit for each key up to `limit`. `N` is a multiple of eight, and at most 32.
            #[inline(always)]
            fn at_most<const N: usize>(keys: &[T; N], limit: T) -> u32 {
                let mut mask = 0;
                for (lane, &key) in keys.iter().enumerate() {
                    mask |= u32::from(key <= limit) << lane;
                }
                mask
            }
        }
    };
}

operations! {
    add: |x, y| x + y;
    sub: |x, y| x - y;
    mul: |x, y| x * y;
    div: |x, y| x / y;
    max: |x, y| if x > y { x } else { y };
    min: |x, y| if x < y { x } else { y };
    abs: |x| x.abs();
    sqrt: |x| x.sqrt();
}

/// `N` numbers, and the instruction set that computes with them.
#[derive(Debug)]
#[repr(align(64))]
pub(crate) struct Lanes<S, T, const N: usize>(pub(crate) [T; N], PhantomData<S>);

impl<S, T: Copy, const N: usize> Clone for Lanes<S, T, N> {
    #[inline(always)]
    fn clone(&self) -> Self {
        *self
    }
}

impl<S, T: Copy, const N: usize> Copy for Lanes<S, T, N> {}

impl<S: Operations<T>, T: Number, const N: usize> Lanes<S, T, N> {
    #[inline(always)]
    pub(crate) fn of(numbers: [T; N]) -> Self {
        Self(numbers, PhantomData)
    }

    #[inline(always)]
    pub(crate) fn splat(x: T) -> Self {
        Self([x; N], PhantomData)
    }

    /// The first `N` numbers of a column.
    #[inline(always)]
    pub(crate) fn load(column: &[T]) -> Self {
        let column = column.first_chunk().expect("a column has N numbers");
        Self(*column, PhantomData)
    }

    /// The greater. (Not `f64::max`: its care for a NaN on either side takes three instructions instead of one.)
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

impl<S: Operations<T>, T: Number, const N: usize> Add for Lanes<S, T, N> {
    type Output = Self;

    #[inline(always)]
    fn add(self, other: Self) -> Self {
        Self(S::add(self.0, other.0), PhantomData)
    }
}

impl<S: Operations<T>, T: Number, const N: usize> Sub for Lanes<S, T, N> {
    type Output = Self;

    #[inline(always)]
    fn sub(self, other: Self) -> Self {
        Self(S::sub(self.0, other.0), PhantomData)
    }
}

impl<S: Operations<T>, T: Number, const N: usize> Div for Lanes<S, T, N> {
    type Output = Self;

    #[inline(always)]
    fn div(self, other: Self) -> Self {
        Self(S::div(self.0, other.0), PhantomData)
    }
}

impl<S: Operations<T>, T: Number, const N: usize> Mul for Lanes<S, T, N> {
    type Output = Self;

    #[inline(always)]
    fn mul(self, other: Self) -> Self {
        Self(S::mul(self.0, other.0), PhantomData)
    }
}
