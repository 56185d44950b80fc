//! R^n: Euclidean distance, canonical form.

use super::error::{StateError, StateProblem};
use crate::lanes::{Isa, Lanes, MAX_CHILDREN, Number, Operations, Rows};

/// Coordinates above this magnitude are refused: 256 squared differences of them still have a finite sum.
pub(super) const MAX_MAGNITUDE: f64 = 1e150;

/// Σ (aᵢ − bᵢ)², in coordinate order.
#[inline]
pub(super) fn distance_2(a: &[f64], b: &[f64]) -> f64 {
    let mut sum_2 = 0.0;
    for (x, y) in a.iter().zip(b) {
        let difference = x - y;
        sum_2 += difference * difference;
    }
    sum_2
}

/// The distance from a coordinate to an interval. Its operations are monotone, as those of the distance to a point are.
#[inline]
pub(super) fn to_interval(x: f64, lo: f64, hi: f64) -> f64 {
    (lo - x).max(x - hi).max(0.0)
}

/// The squared distance from a coordinate to an interval.
#[inline]
pub(crate) fn to_interval_2(x: f64, lo: f64, hi: f64) -> f64 {
    let d = to_interval(x, lo, hi);
    d * d
}

/// The squared distances from the point `sign · state` to boxes.
#[inline(always)]
pub(crate) fn to_boxes_2<I: Isa>(
    state: &[f64],
    sign: f64,
    ends: &[f64],
) -> Lanes<I, f64, MAX_CHILDREN> {
    let zero = Lanes::splat(0.0);
    let mut sum_2 = zero;
    for (&x, ends) in state.iter().zip(ends.chunks_exact(2 * MAX_CHILDREN)) {
        let x = Lanes::splat(sign * x);
        let (lo, hi) = (Lanes::load(ends), Lanes::load(&ends[MAX_CHILDREN..]));
        let d = (lo - x).max(x - hi).max(zero);
        sum_2 = sum_2 + d * d;
    }
    sum_2
}

/// The squared distances to points.
#[inline(always)]
pub(crate) fn to_points_2<I, T, const N: usize, R>(
    query: &[T],
    columns: &[R::Stored],
) -> Lanes<I, T, N>
where
    I: Isa + Operations<T>,
    T: Number,
    R: Rows<T, N>,
{
    let mut sum_2 = Lanes::splat(T::near(0.0));
    for (&x, column) in query.iter().zip(columns.chunks_exact(N)) {
        let d = Lanes::splat(x) - R::load(column);
        sum_2 = sum_2 + d * d;
    }
    sum_2
}

/// The segment from `a` to `b`.
pub(super) fn interpolate(a: &[f64], b: &[f64], t: f64, between: &mut [f64]) {
    for ((x, a), b) in between.iter_mut().zip(a).zip(b) {
        *x = a + t * (b - a);
    }
}

/// The ends of a canonical coordinate.
pub(super) const ENDS: [f64; 2] = [-MAX_MAGNITUDE, MAX_MAGNITUDE];

/// Checks the coordinates, and turns −0.0 into 0.0.
pub(super) fn canonicalize(coordinates: &mut [f64]) -> Result<(), StateError> {
    for (i, x) in coordinates.iter_mut().enumerate() {
        if !x.is_finite() {
            return Err(StateError::not_finite(i, *x));
        }
        if x.abs() > MAX_MAGNITUDE {
            return Err(StateError::new(i, StateProblem::TooLarge));
        }
        *x += 0.0;
    }
    Ok(())
}
