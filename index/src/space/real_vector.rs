//! R^n: Euclidean distance, bound to a cell, canonical form.

use super::error::{StateError, StateProblem};

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

/// The distance from `p` to the interval [lo, hi], in one coordinate.
///
/// It is at most the |p − q| that [`distance_2`] squares, bit for bit, for every q in [lo, hi]: rounding is monotone,
/// so q ≥ lo gives fl(q − p) ≥ fl(lo − p), and likewise at hi. Squaring and adding in coordinate order is monotone
/// too, so the squares of these bounds add up to a bound of the sum.
#[inline]
pub(crate) fn bound(p: f64, lo: f64, hi: f64) -> f64 {
    (lo - p).max(p - hi).max(0.0)
}

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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::space::tests::cases;
    use proptest::prelude::*;

    #[test]
    fn bound_is_the_distance_to_the_interval() {
        assert_eq!(bound(-3.0, -1.0, 2.0), 2.0);
        assert_eq!(bound(-1.0, -1.0, 2.0), 0.0);
        assert_eq!(bound(0.5, -1.0, 2.0), 0.0);
        assert_eq!(bound(2.0, -1.0, 2.0), 0.0);
        assert_eq!(bound(5.0, -1.0, 2.0), 3.0);
    }

    proptest! {
        #![proptest_config(cases(2000))]

        #[test]
        fn bound_never_exceeds_the_distance(
            rows in prop::collection::vec((-10.0..10.0, -10.0..10.0, -10.0..10.0, 0.0..=1.0), 1..6),
            magnitude in -20..20_i32,
        ) {
            let scale = 10_f64.powi(magnitude);
            let (mut p, mut q, mut bound_2) = (Vec::new(), Vec::new(), 0.0);
            for (x, one, other, fraction) in rows {
                let (lo, hi) = (f64::min(one, other) * scale, f64::max(one, other) * scale);
                p.push(x * scale);
                q.push(f64::clamp(lo + fraction * (hi - lo), lo, hi));
                let d = bound(x * scale, lo, hi);
                bound_2 += d * d;
            }
            prop_assert!(bound_2 <= distance_2(&p, &q));
        }
    }
}
