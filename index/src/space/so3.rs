//! Rotations of three-space, RP³, as unit quaternions x, y, z, w: angle, lower bounds of it, canonical form.

use super::{
    error::{StateError, StateProblem},
    real_vector,
};
use crate::lanes::{BLOCK_ROWS, Isa, Lanes, MAX_CHILDREN, Number, Operations, Rows, asin};
use std::f64::consts::FRAC_PI_2;

/// The greatest difference of a norm from 1: with a greater one the numbers are most likely no quaternion.
const NORM_TOLERANCE: f64 = 0.01;

/// A squared norm this near to 1 counts as normalised; [`canonicalize`] says why the tolerance may not be smaller.
const UNIT_TOLERANCE: f64 = 8.0 * f64::EPSILON;

/// The square of half the angle of the rotation between two canonical quaternions.
#[inline]
pub(super) fn distance_2(a: &[f64], b: &[f64]) -> f64 {
    let theta = angle(a, b);
    theta * theta
}

/// acos |a·b|, computed as 2·asin(c/2) from the chord c, the smaller of |a − b| and |a + b|.
///
/// The cosine of a small angle is 1 but for a few bits; its chord is as exact as the coordinates are. Both sums of
/// squares are the same for (a, b) and (b, a), and change places under b → −b, so the angle is symmetric and knows no
/// sign, to the bit.
#[inline]
fn angle(a: &[f64], b: &[f64]) -> f64 {
    (2.0 * libm::asin(chord_2(a, b).sqrt() / 2.0)).min(FRAC_PI_2)
}

/// The squared chord: the smaller of |a − b|² and |a + b|².
#[inline]
fn chord_2(a: &[f64], b: &[f64]) -> f64 {
    let (mut minus_2, mut plus_2) = (0.0, 0.0);
    for (x, y) in a.iter().zip(b) {
        let (minus, plus) = (x - y, x + y);
        minus_2 += minus * minus;
        plus_2 += plus * plus;
    }
    f64::min(minus_2, plus_2)
}

/// The squared angles to a block of canonical quaternions: the bits of [`distance_2`].
#[inline(always)]
pub(crate) fn distances_2<I: Isa>(q: &[f64], columns: &[f64]) -> Lanes<I, f64, BLOCK_ROWS> {
    let zero = Lanes::splat(0.0);
    let (mut minus_2, mut plus_2) = (zero, zero);
    for (&x, column) in q.iter().zip(columns.chunks_exact(BLOCK_ROWS)) {
        let (x, y) = (Lanes::splat(x), Lanes::load(column));
        let (minus, plus) = (x - y, x + y);
        minus_2 = minus_2 + minus * minus;
        plus_2 = plus_2 + plus * plus;
    }
    // Half of the smaller chord is at most sin(π/4), but for the roundings of norms.
    let half_chord = minus_2.min(plus_2).sqrt() * Lanes::splat(0.5);
    let angle = Lanes::splat(2.0) * asin::<I, BLOCK_ROWS>(half_chord);
    let angle = angle.min(Lanes::splat(FRAC_PI_2));
    angle * angle
}

/// A lower bound of the squared angle to a box, from the chord to the nearer of q and −q.
#[inline]
pub(crate) fn to_box_2(q: &[f64], lo: [f64; 4], hi: [f64; 4]) -> f64 {
    let (mut plus_2, mut minus_2) = (0.0, 0.0);
    for (&x, (lo, hi)) in q.iter().zip(lo.into_iter().zip(hi)) {
        plus_2 += real_vector::to_interval_2(x, lo, hi);
        minus_2 += real_vector::to_interval_2(-x, lo, hi);
    }
    from_chord_2(f64::min(plus_2, minus_2))
}

/// A lower bound of the squared angle that belongs to a squared chord: the first terms of its series.
#[inline]
fn from_chord_2(s: f64) -> f64 {
    let [c1, c2, c3] = SERIES;
    s * ((1.0 + s * c1) + (s * s) * (c2 + s * c3))
}

/// Lower bounds of the squared angles to boxes: to the nearer of q and −q.
#[inline(always)]
pub(crate) fn to_boxes_2<I: Isa>(state: &[f64], ends: &[f64]) -> Lanes<I, f64, MAX_CHILDREN> {
    let plus_2 = real_vector::to_boxes_2(state, 1.0, ends);
    let s = plus_2.min(real_vector::to_boxes_2(state, -1.0, ends));
    // The series has one term less than for points. The result is at most 1.2 % lower, which only the largest angles
    // reach.
    let [c1, c2, _] = SERIES.map(Lanes::splat);
    s * ((Lanes::splat(1.0) + s * c1) + (s * s) * c2)
}

/// Lower bounds of the squared angles to points, from their cosines. `cosine` is the part of the cosines that is the
/// same for all points.
#[inline(always)]
pub(crate) fn to_points_2<I, T, const N: usize, R>(
    query: &[T],
    cosine: T,
    columns: &[R::Stored],
) -> Lanes<I, T, N>
where
    I: Isa + Operations<T>,
    T: Number,
    R: Rows<T, N>,
{
    let mut cosine = Lanes::splat(cosine);
    for (&x, column) in query.iter().zip(columns.chunks_exact(N)) {
        cosine = cosine + Lanes::splat(x) * R::load(column);
    }
    let cosine = cosine.abs();
    let s = Lanes::splat(T::near(2.0 - R::CHORD_SLACK)) - (cosine + cosine);
    let s = s.max(Lanes::splat(T::near(0.0)));
    let [c1, c2, c3] = SERIES;
    let [c1, c2] = [Lanes::splat(T::near(c1)), Lanes::splat(T::near(c2))];
    let c3 = Lanes::splat(T::near(c3));
    // The two halves of the sum are independent (Estrin's scheme).
    s * ((Lanes::splat(T::near(1.0)) + s * c1) + (s * s) * (c2 + s * c3))
}

/// The shorter great arc from `a` to `b` or −b (slerp): rotation about a fixed axis at a constant rate; to `b` if both
/// are equally long.
pub(super) fn interpolate(a: &[f64], b: &[f64], t: f64, between: &mut [f64]) {
    /// Below this the sines equal their angles to the last bit, and their quotients are `1 − t` and `t`.
    const STRAIGHT: f64 = 1e-8;
    let dot: f64 = a.iter().zip(b).map(|(x, y)| x * y).sum();
    let sign = if dot < 0.0 { -1.0 } else { 1.0 };
    let theta = angle(a, b);
    let (from, to) = if theta < STRAIGHT {
        (1.0 - t, t)
    } else {
        let sin = libm::sin(theta);
        let from = libm::sin((1.0 - t) * theta) / sin;
        (from, libm::sin(t * theta) / sin)
    };
    for ((x, a), b) in between.iter_mut().zip(a).zip(b) {
        *x = from * a + sign * to * b;
    }
}

/// The angle belonging to the squared chord s is θ = 2·asin(√s/2), and
///
/// > θ² = s·(1 + s/12 + s²/90 + s³/560 + …)
///
/// has only positive terms, so that leaving out the rest bounds it from below. These are the coefficients after 1.
/// Such a bound may exceed a computed angle by some units in the last place (less than 1e-14 of it); pruning leaves
/// that margin.
const SERIES: [f64; 3] = [1.0 / 12.0, 1.0 / 90.0, 1.0 / 560.0];

/// The ends of a coordinate of a canonical quaternion.
pub(super) const ENDS: [f64; 2] = [-1.0 - UNIT_TOLERANCE, 1.0 + UNIT_TOLERANCE];

/// The least coordinate of a unit quaternion, and the length of all coordinates.
pub(super) const SPAN: (f64, f64) = (-1.0, 2.0);

/// True if [`canonicalize`] changes nothing in a quaternion without −0.0.
#[inline]
pub(super) fn is_canonical(q: &[f64]) -> bool {
    let mut norm_2 = 0.0;
    for x in q {
        norm_2 += x * x;
    }
    (norm_2 - 1.0).abs() <= UNIT_TOLERANCE && !is_negative(q)
}

/// True if −q is canonical instead of q: w decides, or the first of x, y, z that is not 0 where w is.
#[inline]
fn is_negative(q: &[f64]) -> bool {
    let deciding = [q[3], q[0], q[1], q[2]].into_iter().find(|x| *x != 0.0);
    deciding.is_some_and(|x| x < 0.0)
}

/// Checks the quaternion, normalises it, and chooses its sign: w > 0, or w = 0 and the first non-zero of x, y, z
/// positive.
///
/// Doing it twice changes no bit. With u = ε/2, the computed squared norm n of any quaternion is off by at most 4u
/// relatively (one rounding for a square, three for the sums), so √n by 2u, and by 3u with its own rounding.
/// Dividing by it adds at most u to each coordinate, so the norm of the quotients is off from 1 by at most 4u, its
/// square by 8u, and the square as computed by 12u = 6ε, plus terms in u² and what underflows, both far below the 2ε
/// that are left to `UNIT_TOLERANCE`. So the second time the norm counts as 1 and nothing is divided. A sign changes no
/// square, and once chosen stays.
pub(super) fn canonicalize(q: &mut [f64]) -> Result<(), StateError> {
    if let Some(i) = q.iter().position(|x| !x.is_finite()) {
        return Err(StateError::not_finite(i, q[i]));
    }
    let mut norm_2 = 0.0;
    for x in q.iter() {
        norm_2 += x * x;
    }
    let norm = norm_2.sqrt();
    if (norm - 1.0).abs() > NORM_TOLERANCE {
        return Err(StateError::new(0, StateProblem::Norm(norm)));
    }
    if (norm_2 - 1.0).abs() > UNIT_TOLERANCE {
        for x in q.iter_mut() {
            *x /= norm;
        }
    }
    let negative = is_negative(q);
    for x in q.iter_mut() {
        // Adding 0.0 makes −0.0 0.0.
        *x = if negative { -*x } else { *x } + 0.0;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn series_bounds_the_squared_angle_from_below() {
        for i in 0..=2000 {
            let s = f64::from(i) / 1000.0; // up to 2, where the angle is π/2
            let theta = 2.0 * libm::asin(s.sqrt() / 2.0);
            let [c1, c2, _] = SERIES;
            let of_box = s * ((1.0 + s * c1) + (s * s) * c2);
            let bound = from_chord_2(s);
            assert!(
                of_box <= bound && bound <= theta * theta * (1.0 + 1e-15),
                "{s}"
            );
        }
    }
}
