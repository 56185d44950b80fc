//! Lower bounds of the distance from a state to the boxes of a node, or to a block of points, as keys of the space (see
//! `key`).
//!
//! The space is read at run time: a loop over groups and factors around the lanes. The arithmetic of a factor is in the
//! factor's file in `space`. **Rounding:** every term is computed by the operations of [`Space::distance`], in their
//! order, on equal operands (of a point) or no greater ones (of a box), and rounding is monotone. So no term exceeds
//! its counterpart, except that of a rotation, which may by 1e-14. (For quantised points, see `quantize`.) No key is
//! NaN: coordinates are small enough for their squares to have a finite sum, and weights for one another.

use crate::{
    Factor, Space,
    lanes::{BLOCK_ROWS, Isa, Lanes, MAX_CHILDREN, Number, Operations, Rows},
    space::{Part, real_vector, so2, so3},
};

/// Lower bounds of the squared distances in one factor, to `N` boxes or points. (This is a trait, because a closure
/// called from two places would be compiled separately, for the oldest processor.)
pub(crate) trait FactorBounds<T: Number, const N: usize> {
    /// The bounds in one of the parts of the space.
    fn bounds_2<I: Isa + Operations<T>>(&self, part_index: usize, part: &Part) -> Lanes<I, T, N>;

    /// The weight of such a squared distance.
    #[inline(always)]
    fn weight(&self, _: usize, part: &Part) -> T {
        T::near(part.weight)
    }

    /// The weight of the root of a group's sum, where there are several groups.
    #[inline(always)]
    fn group_weight(&self, space: &Space, group: usize) -> T {
        T::near(space.groups()[group].weight)
    }
}

/// The boxes of a node.
pub(super) struct BoxBounds<'a> {
    pub(super) state: &'a [f64],
    pub(super) ends: &'a [f64],
}

/// A block of points.
pub(super) struct PointRows<'a> {
    pub(super) state: &'a [f64],
    pub(super) columns: &'a [f64],
}

/// A block of points, whose distances are computed instead of bounded.
pub(super) struct MeasuredRows<'a>(pub(super) PointRows<'a>);

impl FactorBounds<f64, BLOCK_ROWS> for MeasuredRows<'_> {
    #[inline(always)]
    fn bounds_2<I: Isa>(&self, part_index: usize, part: &Part) -> Lanes<I, f64, BLOCK_ROWS> {
        let (PointRows { state, columns }, axes) = (&self.0, part.axes());
        match part.factor {
            Factor::SO3 => {
                let columns = &columns[axes.start * BLOCK_ROWS..axes.end * BLOCK_ROWS];
                so3::distances_2(&state[axes], columns)
            }
            _ => self.0.bounds_2(part_index, part),
        }
    }
}

impl FactorBounds<f64, MAX_CHILDREN> for BoxBounds<'_> {
    #[inline(always)]
    fn bounds_2<I: Isa>(&self, _: usize, part: &Part) -> Lanes<I, f64, MAX_CHILDREN> {
        let axes = part.axes();
        let ends = &self.ends[axes.start * 2 * MAX_CHILDREN..axes.end * 2 * MAX_CHILDREN];
        let state = &self.state[axes];
        match part.factor {
            Factor::RealVector(_) => real_vector::to_boxes_2(state, 1.0, ends),
            Factor::SO2 { period } => so2::to_boxes_2(state[0], period, ends),
            Factor::SO3 => so3::to_boxes_2(state, ends),
        }
    }
}

impl FactorBounds<f64, BLOCK_ROWS> for PointRows<'_> {
    #[inline(always)]
    fn bounds_2<I: Isa>(&self, part_index: usize, part: &Part) -> Lanes<I, f64, BLOCK_ROWS> {
        point_bounds_2(self, part_index, part)
    }
}

/// The bounds of a block of points in one factor.
#[inline(always)]
pub(crate) fn point_bounds_2<I, T, const N: usize, R>(
    rows: &R,
    part_index: usize,
    part: &Part,
) -> Lanes<I, T, N>
where
    I: Isa + Operations<T>,
    T: Number,
    R: Rows<T, N>,
{
    let axes = part.axes();
    let columns = &rows.columns()[axes.start * N..axes.end * N];
    let query = &rows.query()[axes];
    match part.factor {
        Factor::RealVector(_) => real_vector::to_points_2::<I, T, N, R>(query, columns),
        Factor::SO2 { period } => {
            so2::to_points_2::<I, T, N, R>(query[0], R::period(period), columns)
        }
        Factor::SO3 => {
            so3::to_points_2::<I, T, N, R>(query, rows.cosine_of_lows(part_index), columns)
        }
    }
}

impl Rows<f64, BLOCK_ROWS> for PointRows<'_> {
    type Stored = f64;

    /// The squared chord min(|x − y|², |x + y|²) may lie this far below 2 − 2·|x·y| as computed: squared norms are off
    /// from 1 by 20u each, the sum of four products by 4u, u = ε/2, and 2 − 2·|x·y| by another 2u: 50u in all.
    /// Rotations nearer than 1e-7 to each other are not pruned; half of the kernel is saved.
    const CHORD_SLACK: f64 = 32.0 * f64::EPSILON;

    #[inline(always)]
    fn load<I: Isa>(column: &[f64]) -> Lanes<I, f64, BLOCK_ROWS> {
        Lanes::load(column)
    }

    #[inline(always)]
    fn query(&self) -> &[f64] {
        self.state
    }

    #[inline(always)]
    fn columns(&self) -> &[f64] {
        self.columns
    }

    #[inline(always)]
    fn period(period: f64) -> f64 {
        period
    }

    #[inline(always)]
    fn cosine_of_lows(&self, _: usize) -> f64 {
        0.0
    }
}

/// The keys composed of the bounds in all factors.
#[inline(always)]
pub(crate) fn keys<I, T: Number, const N: usize>(
    space: &Space,
    of: &impl FactorBounds<T, N>,
) -> Lanes<I, T, N>
where
    I: Isa + Operations<T>,
{
    // One loop over the factors, so that the terms are compiled once.
    let one_group = space.groups().len() == 1;
    let zero = Lanes::splat(T::near(0.0));
    let (mut total, mut sum_2) = (zero, zero);
    for (part_index, part) in space.parts().iter().enumerate() {
        sum_2 = sum_2 + Lanes::splat(of.weight(part_index, part)) * of.bounds_2(part_index, part);
        if !one_group && part.ends_group {
            let weight = of.group_weight(space, part.group);
            total = total + Lanes::splat(weight) * sum_2.sqrt();
            sum_2 = zero;
        }
    }
    if one_group { sum_2 } else { total }
}
