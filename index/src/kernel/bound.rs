//! Lower bounds of the distance from a state to sixteen boxes, or to a block of points, side by side, as keys of the
//! space (see `limit`).
//!
//! The space is read as it is, a loop over groups and factors around the lanes. **Rounding:** every term is computed by
//! the operations of [`Space::distance`], in their order, on operands that are the same (a point's) or no greater (a
//! box's), and rounding is monotone: so no term exceeds its counterpart, but for a rotation's, which may by 1e-14. (Of
//! points whose numbers are rounded, see `coded`.)
//! No key is NaN: coordinates are small enough for their squares to have a finite sum, and weights for one another.

use super::{
    compiled::Set,
    lanes::{Lanes, Number, Operations},
};
use crate::{
    Factor, Space,
    space::{Part, SO3_SERIES},
};

/// How many children a node has at most: the lanes of a box kernel, two registers of eight. A search waits for one node
/// after the other more than it computes: with nodes of eight, it took 1.05 to 1.2 times as long.
pub(crate) const CHILDREN: usize = 16;

/// How many points a block has at most: the lanes of a point kernel.
pub(crate) const BLOCK: usize = 16;

/// What the kernels bound the distance to, `N` side by side: by its squared distance in each factor. (Not a closure:
/// one that is called from two places would be compiled by itself, for the oldest processor.)
pub(super) trait Terms<T: Number, const N: usize> {
    /// A lower bound of the squared distances in a factor, the one at `place` among the parts of the space.
    fn term<S: Set>(&self, place: usize, part: &Part) -> Lanes<S, T, N>;

    /// What such a squared distance counts.
    #[inline(always)]
    fn weight(&self, _: usize, part: &Part) -> T {
        T::near(part.weight)
    }

    /// What the root of a group's sum counts, where there are several.
    #[inline(always)]
    fn group_weight(&self, space: &Space, group: usize) -> T {
        T::near(space.groups()[group].weight)
    }
}

/// Boxes: coordinate by coordinate the lower ends, and then the upper ends of all of them.
pub(super) struct Boxes<'a> {
    pub(super) state: &'a [f64],
    pub(super) ends: &'a [f64],
}

/// Points: coordinate by coordinate the numbers of all of them.
pub(super) struct Points<'a> {
    pub(super) state: &'a [f64],
    pub(super) columns: &'a [f64],
}

/// How far the squared chord min(|x − y|², |x + y|²) may lie below 2 − 2·|x·y| as it is computed: squared norms are
/// off from 1 by 20u each, the sum of four products by 4u, u = ε/2, and 2 − 2·|x·y| by another 2u: 50u in all.
/// What is lost is the pruning among rotations nearer than 1e-7 to each other; what is saved is half of the kernel.
const COSINE_SLACK: f64 = 32.0 * f64::EPSILON;

impl Terms<f64, CHILDREN> for Boxes<'_> {
    #[inline(always)]
    fn term<S: Set>(&self, _: usize, part: &Part) -> Lanes<S, f64, CHILDREN> {
        box_term(part, self.state, self.ends)
    }
}

impl Terms<f64, BLOCK> for Points<'_> {
    #[inline(always)]
    fn term<S: Set>(&self, _: usize, part: &Part) -> Lanes<S, f64, BLOCK> {
        point_term(part, self.state, self.columns)
    }
}

/// The keys that the squared distances in each factor make.
#[inline(always)]
pub(super) fn keys<S, T: Number, const N: usize>(
    space: &Space,
    of: &impl Terms<T, N>,
) -> Lanes<S, T, N>
where
    S: Set + Operations<T>,
{
    // One loop over the factors, so that the terms are compiled once.
    let one_group = space.groups().len() == 1;
    let zero = Lanes::splat(T::near(0.0));
    let (mut total, mut sum_2) = (zero, zero);
    for (place, part) in space.parts().iter().enumerate() {
        sum_2 = sum_2 + Lanes::splat(of.weight(place, part)) * of.term(place, part);
        if !one_group && part.ends_group {
            let weight = of.group_weight(space, part.group);
            total = total + Lanes::splat(weight) * sum_2.sqrt();
            sum_2 = zero;
        }
    }
    if one_group { sum_2 } else { total }
}

#[inline(always)]
fn box_term<S: Set>(part: &Part, state: &[f64], ends: &[f64]) -> Lanes<S, f64, CHILDREN> {
    let axes = part.offset..part.offset + part.factor.coordinates();
    let state = &state[axes.clone()];
    let ends = &ends[axes.start * 2 * CHILDREN..axes.end * 2 * CHILDREN];
    match part.factor {
        Factor::RealVector(_) => to_boxes_2(state, 1.0, ends),
        Factor::SO2 { period } => {
            let (x, zero) = (Lanes::splat(state[0]), Lanes::splat(0.0));
            let (lo, hi) = (Lanes::load(ends), Lanes::load(&ends[CHILDREN..]));
            // Outside the interval the nearer end bounds the direct arc, and the farther end the arc across the seam:
            // of hi − x and x − lo the one that is not negative is the arc to it.
            let direct = (lo - x).max(x - hi).max(zero);
            let across = (Lanes::splat(period) - (hi - x).max(x - lo)).max(zero);
            let d = direct.min(across);
            d * d
        }
        Factor::SO3 => {
            angle_2_to_box(to_boxes_2(state, 1.0, ends).min(to_boxes_2(state, -1.0, ends)))
        }
    }
}

/// The squared Euclidean distances from the point `sign · state` to the boxes.
#[inline(always)]
fn to_boxes_2<S: Set>(state: &[f64], sign: f64, ends: &[f64]) -> Lanes<S, f64, CHILDREN> {
    let zero = Lanes::splat(0.0);
    let mut sum_2 = zero;
    for (&x, ends) in state.iter().zip(ends.chunks_exact(2 * CHILDREN)) {
        let x = Lanes::splat(sign * x);
        let (lo, hi) = (Lanes::load(ends), Lanes::load(&ends[CHILDREN..]));
        let d = (lo - x).max(x - hi).max(zero);
        sum_2 = sum_2 + d * d;
    }
    sum_2
}

#[inline(always)]
fn point_term<S: Set>(part: &Part, state: &[f64], columns: &[f64]) -> Lanes<S, f64, BLOCK> {
    let zero = Lanes::splat(0.0);
    let axes = part.offset..part.offset + part.factor.coordinates();
    let state = &state[axes.clone()];
    let columns = &columns[axes.start * BLOCK..axes.end * BLOCK];
    match part.factor {
        Factor::RealVector(_) => {
            let mut sum_2 = zero;
            for (&x, column) in state.iter().zip(columns.chunks_exact(BLOCK)) {
                let d = Lanes::splat(x) - Lanes::load(column);
                sum_2 = sum_2 + d * d;
            }
            sum_2
        }
        Factor::SO2 { period } => {
            let direct = (Lanes::splat(state[0]) - Lanes::load(columns)).abs();
            let d = direct.min(Lanes::splat(period) - direct).max(zero);
            d * d
        }
        Factor::SO3 => {
            let mut cosine = zero;
            for (&x, column) in state.iter().zip(columns.chunks_exact(BLOCK)) {
                cosine = cosine + Lanes::splat(x) * Lanes::load(column);
            }
            let cosine = cosine.abs();
            angle_2((Lanes::splat(2.0 - COSINE_SLACK) - (cosine + cosine)).max(zero))
        }
    }
}

/// As [`angle_2`], with one term less: at most 1.2 % below it, and so far only among the largest angles.
#[inline(always)]
fn angle_2_to_box<S: Set, const N: usize>(s: Lanes<S, f64, N>) -> Lanes<S, f64, N> {
    let [c1, c2, _] = SO3_SERIES.map(Lanes::splat);
    s * ((Lanes::splat(1.0) + s * c1) + (s * s) * c2)
}

/// A lower bound of the squared angle that belongs to the squared chord `s`: the first terms of its series.
#[inline(always)]
pub(super) fn angle_2<S, T: Number, const N: usize>(s: Lanes<S, T, N>) -> Lanes<S, T, N>
where
    S: Operations<T>,
{
    let [c1, c2, c3] = SO3_SERIES;
    let [c1, c2] = [Lanes::splat(T::near(c1)), Lanes::splat(T::near(c2))];
    let c3 = Lanes::splat(T::near(c3));
    // By halves that do not wait for each other (Estrin's scheme).
    s * ((Lanes::splat(T::near(1.0)) + s * c1) + (s * s) * (c2 + s * c3))
}
