//! R^n: Euclidean distance, canonical form.

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
