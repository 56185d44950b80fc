//! Configuration spaces: sums of weighted groups of factors, and *the* distance of each.
//!
//! A space is a sum of groups of factors, and the distance between two states a and b is
//!
//! > d(a, b) = Σ_g w_g · √(Σ_i μ_i · d_i(a, b)²)
//!
//! where g runs over the groups, i over the factors of group g, and d_i is the factor's own distance: Euclidean for
//! `RealVector(n)`, the shorter arc for `SO2`, half the angle of the relative rotation for `SO3`. One group is the
//! weighted product metric of Yershova and LaValle; every factor a group of its own is OMPL's `CompoundStateSpace`.
//!
//! [`Space::distance`] defines a distance bit for bit: the order of the operations is fixed, none is fused, and
//! functions that IEEE 754 does not round correctly come from `libm`. Every reported distance has these bits.

mod error;
mod factor;
mod geodesic;
mod presets;
pub(crate) mod real_vector;
pub(crate) mod so2;
pub(crate) mod so3;
#[cfg(test)]
pub(crate) mod tests;
mod text;

pub use error::{SpaceError, StateError, StateProblem};
pub(crate) use factor::Part;
pub use factor::{Factor, Group, Term};

use std::fmt;
use std::str::FromStr;

/// The number of rows of a table that are checked at once.
const ROWS_AT_ONCE: usize = 8;

/// The bits of −0.0, which no canonical row has.
const NEGATIVE_ZERO: u64 = 1 << 63;

/// A configuration space: the meaning of a row of numbers, and the distance of two rows.
///
/// A space is made from groups, from the terms of one group, or from text, and is valid from then on. It prints its
/// canonical text, and parsing that gives an equal space. Spaces are equal when they are equal after expansion:
/// `R3` equals `sum(R3)`, but `R3*R3` is not `R6`.
///
/// A factor or group of weight 0 makes a pseudo-metric: different states can be at distance 0.
///
/// ```
/// use wayfold_index::Space;
///
/// let space: Space = "R3 * SO3:0.15".parse()?;
/// assert_eq!(space, "mpnn-se3".parse()?);
/// assert_eq!((space.coordinates(), space.dimension()), (7, 6));
///
/// let mut a = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0];
/// let mut b = [3.0, 4.0, 0.0, 0.0, 0.0, 0.0, 1.0];
/// space.canonicalize(&mut a)?;
/// space.canonicalize(&mut b)?;
/// assert_eq!(space.distance(&a, &b), 5.0);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Clone, Debug)]
pub struct Space {
    groups: Vec<Group>,
    /// The factors of all groups, in row order.
    parts: Vec<Part>,
    coordinates: usize,
    /// The ends of each coordinate in canonical form.
    ends: Vec<[f64; 2]>,
    /// The first coordinates of the rotations.
    rotations: Vec<usize>,
}

impl Space {
    /// The maximum number of coordinates of a space.
    pub const MAX_COORDINATES: usize = 256;

    /// The space of these groups.
    ///
    /// # Errors
    /// There is no group or an empty one, a dimension is 0, a period or a weight is out of its range, no factor has
    /// a weight above 0, or there are more than [`Space::MAX_COORDINATES`] coordinates.
    pub fn new(groups: Vec<Group>) -> Result<Space, SpaceError> {
        if groups.is_empty() {
            return Err(SpaceError::Empty);
        }
        let (mut coordinates, mut weighted) = (0_usize, false);
        for (g, group) in groups.iter().enumerate() {
            if group.terms.is_empty() {
                return Err(SpaceError::EmptyGroup(g));
            }
            check_weight(group.weight, g, None)?;
            for (t, term) in group.terms.iter().enumerate() {
                check_weight(term.weight, g, Some(t))?;
                term.factor.validate()?;
                coordinates = coordinates.saturating_add(term.factor.coordinates());
                weighted |= group.weight > 0.0 && term.weight > 0.0;
            }
        }
        if coordinates > Self::MAX_COORDINATES {
            return Err(SpaceError::TooManyCoordinates);
        }
        if !weighted {
            return Err(SpaceError::NoWeight);
        }
        Ok(Self::from_valid(groups))
    }

    /// The space of one group of weight 1, d = √(Σ_i μ_i · d_i²).
    ///
    /// # Errors
    /// The errors of [`Space::new`].
    pub fn product(terms: Vec<Term>) -> Result<Space, SpaceError> {
        Self::new(vec![Group { weight: 1.0, terms }])
    }

    /// `R2*SO2`: poses in the plane, rows x, y, angle.
    pub fn se2() -> Space {
        let terms = vec![Factor::RealVector(2).into(), Factor::so2().into()];
        Self::from_valid(vec![Group { weight: 1.0, terms }])
    }

    /// `R3*SO3:0.15`: poses in space with the paper's weights, rows x, y, z and the quaternion x, y, z, w.
    pub fn se3() -> Space {
        let rotation = Term {
            factor: Factor::SO3,
            weight: 0.15,
        };
        let terms = vec![Factor::RealVector(3).into(), rotation];
        Self::from_valid(vec![Group { weight: 1.0, terms }])
    }

    fn from_valid(mut groups: Vec<Group>) -> Space {
        let (mut parts, mut ends, mut rotations, mut offset) = (vec![], vec![], vec![], 0);
        for (g, group) in groups.iter_mut().enumerate() {
            // Adding 0.0 makes −0.0, a valid weight, 0.0, which is what it prints as.
            group.weight += 0.0;
            let last = group.terms.len() - 1;
            for (t, term) in group.terms.iter_mut().enumerate() {
                term.weight += 0.0;
                let weight = if group.weight > 0.0 { term.weight } else { 0.0 };
                parts.push(Part {
                    factor: term.factor,
                    offset,
                    weight,
                    // The product with a length of 0 is 0, as for any finite weight.
                    unit_length: (group.weight * weight.sqrt()).min(f64::MAX),
                    group: g,
                    ends_group: t == last,
                });
                let coordinates = term.factor.coordinates();
                ends.extend((0..coordinates).map(|_| term.factor.ends()));
                if term.factor == Factor::SO3 {
                    rotations.push(offset);
                }
                offset += coordinates;
            }
        }
        Space {
            groups,
            parts,
            coordinates: offset,
            ends,
            rotations,
        }
    }

    /// Its groups, in row order.
    pub fn groups(&self) -> &[Group] {
        &self.groups
    }

    /// The number of coordinates in a row (SE(3): 7).
    pub fn coordinates(&self) -> usize {
        self.coordinates
    }

    /// Its dimension as a manifold (SE(3): 6).
    pub fn dimension(&self) -> usize {
        self.parts.iter().map(|part| part.factor.dimension()).sum()
    }

    /// Checks one row and brings it into canonical form, in place.
    ///
    /// In canonical form there is no −0.0, an `SO2` angle lies in [−P/2, P/2) for its period P, and an `SO3`
    /// quaternion is normalised, with w > 0 or with w = 0 and the first non-zero of x, y, z positive. A row in
    /// canonical form is left as it is, to the bit. After an error the row may be partly canonical.
    ///
    /// # Errors
    /// The row has another width than the space, or a coordinate that is NaN, infinite or (in `RealVector`) above
    /// 1e150 in magnitude, or a quaternion whose norm is off by more than 1 %. The first such coordinate is named.
    pub fn canonicalize(&self, row: &mut [f64]) -> Result<(), StateError> {
        if row.len() != self.coordinates {
            return Err(StateError::width(self.coordinates, row.len()));
        }
        for part in &self.parts {
            part.factor
                .canonicalize(&mut row[part.axes()])
                .map_err(|error| error.shifted(part.offset))?;
        }
        Ok(())
    }

    /// Checks that a row is in canonical form: that [`Space::canonicalize`] would leave it as it is, to the bit.
    ///
    /// # Errors
    /// The errors of [`Space::canonicalize`], or [`StateProblem::NotCanonical`] with the first coordinate that it would
    /// change.
    #[inline]
    pub fn check_canonical(&self, row: &[f64]) -> Result<(), StateError> {
        if self.is_canonical(row) {
            return Ok(());
        }
        Err(self.canonical_problem(row))
    }

    /// Acts like [`Space::check_canonical`] for all rows of a table, one after the other; names the row of an error.
    pub(crate) fn check_all_canonical(&self, rows: &[f64]) -> Result<(), (usize, StateError)> {
        if rows.len() > ROWS_AT_ONCE * self.coordinates && self.are_canonical(rows) {
            return Ok(());
        }
        let mut rows = rows.chunks(self.coordinates).enumerate();
        rows.try_for_each(|(at, row)| self.check_canonical(row).map_err(|error| (at, error)))
    }

    fn are_canonical(&self, rows: &[f64]) -> bool {
        // No comparison decides about the next one, so that registers of any width are filled.
        let ends = self.ends.repeat(ROWS_AT_ONCE);
        let in_range = rows.chunks(ends.len()).all(|rows| {
            let ended = rows.iter().zip(&ends);
            ended.fold(true, |all, (x, [lo, hi])| {
                all & (lo <= x) & (x <= hi) & (x.to_bits() != NEGATIVE_ZERO)
            })
        });
        let mut rows = rows.chunks(self.coordinates);
        in_range && (self.rotations.is_empty() || rows.all(|row| self.has_canonical_rotations(row)))
    }

    #[inline]
    fn has_canonical_rotations(&self, row: &[f64]) -> bool {
        let mut rotations = self.rotations.iter();
        rotations.all(|&at| so3::is_canonical(&row[at..at + 4]))
    }

    #[inline]
    fn is_canonical(&self, row: &[f64]) -> bool {
        // One pass over all coordinates: a check of each factor would slow short searches.
        let mut ended = row.iter().zip(&self.ends);
        row.len() == self.coordinates
            && ended.all(|(x, [lo, hi])| lo <= x && x <= hi && x.to_bits() != NEGATIVE_ZERO)
            && self.has_canonical_rotations(row)
    }

    /// The problem of a row that is not canonical.
    #[cold]
    fn canonical_problem(&self, row: &[f64]) -> StateError {
        let mut canonical = row.to_vec();
        if let Err(error) = self.canonicalize(&mut canonical) {
            return error;
        }
        let mut pairs = row.iter().zip(&canonical);
        let changed = pairs.position(|(a, b)| a.to_bits() != b.to_bits());
        StateError::new(changed.unwrap_or_default(), StateProblem::NotCanonical)
    }

    /// The distance of two canonical rows of this space; symmetric to the bit, and never NaN.
    ///
    /// It is infinite only where a weighted sum exceeds the range of `f64`. The squares of differences below 1.5e-154 are
    /// less exact, and those of differences below 1.5e-162 count as 0.
    ///
    /// # Panics
    /// If a row is shorter than [`Space::coordinates`].
    pub fn distance(&self, a: &[f64], b: &[f64]) -> f64 {
        let (mut total, mut parts) = (0.0, self.parts.as_slice());
        for group in &self.groups {
            let (own, others) = parts.split_at(group.terms.len());
            let mut sum_2 = 0.0;
            for part in own {
                sum_2 += part.weight * part.distance_2(a, b);
            }
            total += group.weight * sum_2.sqrt();
            parts = others;
        }
        total
    }

    /// The factors of all groups, in row order.
    pub(crate) fn parts(&self) -> &[Part] {
        &self.parts
    }

    /// The length of a unit of each coordinate in the metric.
    pub(crate) fn unit_lengths(&self) -> Vec<f64> {
        let parts = self.parts.iter();
        parts
            .flat_map(|part| part.axes().map(|_| part.unit_length))
            .collect()
    }
}

/// Equality after expansion; a space is held expanded.
impl PartialEq for Space {
    fn eq(&self, other: &Space) -> bool {
        self.groups == other.groups
    }
}

impl fmt::Display for Space {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        text::print(self, f)
    }
}

impl FromStr for Space {
    type Err = SpaceError;

    /// Reads the text form, as `R3*SO3:0.15`, `sum(R3, SO3:0.5)`, `(R3*RP3:0.15)^8`, `SO2[1]`, or the name of a
    /// preset: `mpnn-se3`, `ompl-se2`, `ompl-se3`, `ompl-torus`, `moveit-joints-N`.
    fn from_str(text: &str) -> Result<Space, SpaceError> {
        text::parse(text)
    }
}

fn check_weight(weight: f64, group: usize, term: Option<usize>) -> Result<(), SpaceError> {
    if is_weight(weight) {
        Ok(())
    } else {
        Err(SpaceError::Weight {
            group,
            term,
            weight,
        })
    }
}

fn is_weight(weight: f64) -> bool {
    weight.is_finite() && weight >= 0.0
}
