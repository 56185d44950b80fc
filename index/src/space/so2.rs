//! The circle S¹ of a period: arc length, bound to a cell, wrapping.

use super::error::StateError;

/// The periods that are accepted: their squares, and those of the distances that matter, neither overflow nor vanish.
const PERIODS: std::ops::RangeInclusive<f64> = 1e-150..=1e150;

/// Whether `period` can be the circumference of a circle.
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

/// The arc from the canonical angle `p` to the interval [lo, hi] within [−P/2, P/2].
///
/// It is at most the distance to every canonical q in [lo, hi], bit for bit. For p < lo the distance takes
/// fl(q − p) ∈ [fl(lo − p), fl(hi − p)], since rounding is monotone; so its direct arc is at least the one below, its
/// arc across the seam, fl(P − fl(q − p)), is at least fl(P − fl(hi − p)), and so is the smaller of the two. For
/// p > hi the mirror image holds, and in between the bound is 0.
#[inline]
pub(crate) fn bound(p: f64, lo: f64, hi: f64, period: f64) -> f64 {
    let (direct, across) = if p < lo {
        (lo - p, period - (hi - p))
    } else if p > hi {
        (p - hi, period - (p - lo))
    } else {
        return 0.0;
    };
    direct.min(across).max(0.0)
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::space::tests::cases;
    use proptest::prelude::*;
    use std::f64::consts::{PI, TAU};

    #[test]
    fn bound_takes_the_shorter_way_round() {
        assert_eq!(bound(-0.5, -0.25, 0.25, 1.0), 0.25);
        assert_eq!(bound(0.0, -0.25, 0.25, 1.0), 0.0);
        assert_eq!(bound(-0.4375, 0.25, 0.375, 1.0), 0.1875); // across the seam: 0.0625 + 0.125
        assert_eq!(bound(0.4375, -0.375, -0.25, 1.0), 0.1875);
        assert_eq!(bound(0.375, -0.5, 0.25, 1.0), 0.125); // the cell reaches the seam at −P/2
        assert_eq!(bound(PI - 1.0, -PI, -PI, TAU), 1.0);
    }

    proptest! {
        #![proptest_config(cases(5000))]

        #[test]
        fn bound_never_exceeds_the_distance(
            angles in (-0.5..0.5, -0.5..=0.5, -0.5..=0.5, 0.0..=1.0),
            period in prop_oneof![Just(TAU), Just(1.0), 1e-3..1e3],
        ) {
            let (p, one, other, fraction) = angles;
            let half = period / 2.0;
            let p = f64::clamp(p * period, -half, half.next_down());
            let (lo, hi) = (f64::min(one, other) * period, f64::max(one, other) * period);
            for q in [lo, lo + fraction * (hi - lo), hi] {
                let q = q.clamp(lo, hi).min(half.next_down());
                prop_assert!(bound(p, lo.min(q), hi, period) <= distance(p, q, period));
            }
        }
    }
}
