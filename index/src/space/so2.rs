//! The circle S¹ of a period: arc length, wrapping.

use super::{error::StateError, real_vector};
use crate::lanes::{Isa, Lanes, MAX_CHILDREN, Number, Operations, Rows};

/// The periods that are accepted: their squares, and those of the distances that matter, neither overflow nor vanish.
const PERIODS: std::ops::RangeInclusive<f64> = 1e-150..=1e150;

/// True if `period` can be the circumference of a circle.
pub(super) fn is_period(period: f64) -> bool {
    PERIODS.contains(&period)
}

/// The square of the shorter arc between two canonical angles.
#[inline]
pub(super) fn distance_2(a: f64, b: f64, period: f64) -> f64 {
    let d = distance(a, b, period);
    d * d
}

/// The shorter arc between two canonical angles, min(|a − b|, P − |a − b|).
#[inline]
fn distance(a: f64, b: f64, period: f64) -> f64 {
    let direct = (a - b).abs();
    direct.min(period - direct).max(0.0)
}

/// The square of the shorter arc from an angle to an interval.
#[inline]
pub(crate) fn to_interval_2(angle: f64, period: f64, lo: f64, hi: f64) -> f64 {
    // The farther end of the interval is the nearer one around the back of the circle.
    let across = (period - (hi - angle).max(angle - lo)).max(0.0);
    let d = real_vector::to_interval(angle, lo, hi).min(across);
    d * d
}

/// The squares of the shorter arcs from an angle to intervals.
#[inline(always)]
pub(crate) fn to_boxes_2<I: Isa>(
    angle: f64,
    period: f64,
    ends: &[f64],
) -> Lanes<I, f64, MAX_CHILDREN> {
    let (x, zero) = (Lanes::splat(angle), Lanes::splat(0.0));
    let (lo, hi) = (Lanes::load(ends), Lanes::load(&ends[MAX_CHILDREN..]));
    // Outside the interval the nearer end bounds the direct arc, and the farther end the arc across the seam: of hi − x
    // and x − lo the one that is not negative is the arc to it.
    let direct = (lo - x).max(x - hi).max(zero);
    let across = (Lanes::splat(period) - (hi - x).max(x - lo)).max(zero);
    let d = direct.min(across);
    d * d
}

/// The squares of the shorter arcs to points.
#[inline(always)]
pub(crate) fn to_points_2<I, T, const N: usize, R>(
    angle: T,
    period: T,
    column: &[R::Stored],
) -> Lanes<I, T, N>
where
    I: Isa + Operations<T>,
    T: Number,
    R: Rows<T, N>,
{
    let direct = (Lanes::splat(angle) - R::load(column)).abs();
    let across = Lanes::splat(period) - direct;
    let d = direct.min(across).max(Lanes::splat(T::near(0.0)));
    d * d
}

/// The shorter arc from `a` to `b`; the one that does not cross the seam if both are equally long. It may end beyond
/// the seam, and [`canonicalize`] wraps it.
pub(super) fn interpolate(a: f64, b: f64, period: f64, t: f64, between: &mut [f64]) {
    let half = period / 2.0;
    let b = match b - a {
        arc if arc > half => b - period,
        arc if arc < -half => b + period,
        _ => b,
    };
    between[0] = a + t * (b - a);
}

/// The ends of a canonical angle.
pub(super) fn ends(period: f64) -> [f64; 2] {
    let half = period / 2.0;
    [-half, half.next_down()]
}

/// The least canonical angle, and the length of all canonical angles.
pub(super) fn span(period: f64) -> (f64, f64) {
    (-period / 2.0, period)
}

/// Checks the angle and wraps it into [−P/2, P/2).
///
/// An angle that lies there is not touched, so wrapping twice changes no bit. Any other is brought there by the IEEE
/// remainder, which is exact.
pub(super) fn canonicalize(coordinates: &mut [f64], period: f64) -> Result<(), StateError> {
    let half = period / 2.0;
    for (i, angle) in coordinates.iter_mut().enumerate() {
        if !angle.is_finite() {
            return Err(StateError::not_finite(i, *angle));
        }
        if !(-half..half).contains(angle) {
            let wrapped = libm::remainder(*angle, period);
            *angle = if wrapped >= half { -half } else { wrapped };
        }
        *angle += 0.0;
    }
    Ok(())
}
