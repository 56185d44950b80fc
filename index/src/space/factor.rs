//! The factors of a space, and their terms and groups. The arithmetic of each kind of factor is in a file of its own.

use std::{f64::consts::TAU, ops::Range};

use super::{
    error::{SpaceError, StateError},
    real_vector, so2, so3,
};

/// One factor of a space.
///
/// A state holds the coordinates of its factors one after the other, in the order of the space.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Factor {
    /// R^n for the given n ≥ 1: n coordinates, Euclidean distance.
    RealVector(usize),
    /// The circle S¹: one angle. Two angles that differ by the period are the same; the distance is the length of the
    /// shorter arc.
    SO2 {
        /// The circumference, within [1e-150, 1e150]; 2π where angles are radians.
        period: f64,
    },
    /// The rotations of three-space, RP³: a unit quaternion x, y, z, w (w last), where q and −q are the same; the
    /// distance is acos |q₁·q₂| ∈ [0, π/2], half the angle of the rotation between the two.
    SO3,
}

impl Factor {
    /// The circle in radians, `SO2` of period 2π.
    pub const fn so2() -> Factor {
        Factor::SO2 { period: TAU }
    }

    /// The number of its coordinates in a row: n, 1, 4.
    pub const fn coordinates(&self) -> usize {
        match *self {
            Factor::RealVector(n) => n,
            Factor::SO2 { .. } => 1,
            Factor::SO3 => 4,
        }
    }

    /// Its dimension as a manifold: n, 1, 3.
    pub const fn dimension(&self) -> usize {
        match *self {
            Factor::RealVector(n) => n,
            Factor::SO2 { .. } => 1,
            Factor::SO3 => 3,
        }
    }

    /// The squared distance of the factor's canonical coordinates `a` and `b`.
    #[inline]
    pub(crate) fn distance_2(&self, a: &[f64], b: &[f64]) -> f64 {
        match *self {
            Factor::RealVector(_) => real_vector::distance_2(a, b),
            Factor::SO2 { period } => so2::distance_2(a[0], b[0], period),
            Factor::SO3 => so3::distance_2(a, b),
        }
    }

    pub(super) fn canonicalize(&self, coordinates: &mut [f64]) -> Result<(), StateError> {
        match *self {
            Factor::RealVector(_) => real_vector::canonicalize(coordinates),
            Factor::SO2 { period } => so2::canonicalize(coordinates, period),
            Factor::SO3 => so3::canonicalize(coordinates),
        }
    }

    /// The ends of each of its coordinates in canonical form.
    pub(super) fn ends(&self) -> [f64; 2] {
        match *self {
            Factor::RealVector(_) => real_vector::ENDS,
            Factor::SO2 { period } => so2::ends(period),
            Factor::SO3 => so3::ENDS,
        }
    }

    /// The least number and the length of each of its coordinates; None if only the points bound them.
    pub(crate) fn span(&self) -> Option<(f64, f64)> {
        match *self {
            Factor::RealVector(_) => None,
            Factor::SO2 { period } => Some(so2::span(period)),
            Factor::SO3 => Some(so3::SPAN),
        }
    }

    /// The coordinates at the share `t`, strictly between 0 and 1, of the way from `a` to `b`; canonical except for
    /// wrapping.
    pub(super) fn interpolate(&self, a: &[f64], b: &[f64], t: f64, between: &mut [f64]) {
        match *self {
            Factor::RealVector(_) => real_vector::interpolate(a, b, t, between),
            Factor::SO2 { period } => so2::interpolate(a[0], b[0], period, t, between),
            Factor::SO3 => so3::interpolate(a, b, t, between),
        }
    }

    pub(super) fn validate(&self) -> Result<(), SpaceError> {
        match *self {
            Factor::RealVector(0) => Err(SpaceError::NoDimensions),
            Factor::SO2 { period } if !so2::is_period(period) => Err(SpaceError::Period(period)),
            Factor::RealVector(_) | Factor::SO2 { .. } | Factor::SO3 => Ok(()),
        }
    }
}

/// A factor within a group.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Term {
    /// The factor.
    pub factor: Factor,
    /// μ, finite and ≥ 0: multiplies the factor's *squared* distance.
    pub weight: f64,
}

impl From<Factor> for Term {
    /// The factor with weight 1.
    fn from(factor: Factor) -> Term {
        Term {
            factor,
            weight: 1.0,
        }
    }
}

/// A group of factors, whose squared distances are added under one root.
#[derive(Clone, Debug, PartialEq)]
pub struct Group {
    /// w, finite and ≥ 0: multiplies the group's distance.
    pub weight: f64,
    /// The group's factors, at least one.
    pub terms: Vec<Term>,
}

/// One factor of a space, with its coordinates in a row and its weights.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Part {
    pub(crate) factor: Factor,
    /// The factor's first coordinate in a row.
    pub(crate) offset: usize,
    /// μ; 0 also in a group of weight 0, so that an overflowing μ·d² cannot meet that 0 and make a NaN.
    pub(crate) weight: f64,
    /// The length of a unit of its coordinates in the metric: w · √μ.
    pub(crate) unit_length: f64,
    /// The index of its group.
    pub(crate) group: usize,
    /// True if it is the last of its group.
    pub(crate) ends_group: bool,
}

impl Part {
    /// The squared distance in this factor of two canonical rows of the space.
    #[inline]
    pub(crate) fn distance_2(&self, a: &[f64], b: &[f64]) -> f64 {
        self.factor.distance_2(&a[self.axes()], &b[self.axes()])
    }

    /// The coordinates of the factor in a row.
    #[inline(always)]
    pub(crate) fn axes(&self) -> Range<usize> {
        self.offset..self.offset + self.factor.coordinates()
    }
}
