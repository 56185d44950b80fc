//! The errors of spaces and states.

use super::Space;
use thiserror::Error;

/// The error of a space.
#[derive(Clone, Debug, PartialEq, Error)]
pub enum SpaceError {
    /// There is no group.
    #[error("a space needs at least one factor, as in R3")]
    Empty,
    /// The group of this index has no terms.
    #[error("groups[{0}]: a group needs at least one factor")]
    EmptyGroup(usize),
    /// A `RealVector(0)`.
    #[error("R0 has no coordinates: the dimension of a real vector is at least 1")]
    NoDimensions,
    /// A period of an `SO2` that is out of range.
    #[error("period {0:?}: the period of an SO2 is a number from 1e-150 to 1e150")]
    Period(f64),
    /// A weight that is negative, infinite or NaN.
    #[error(
        "groups[{group}]{}: weight {weight:?}: weights are finite and at least 0",
        term.map(|term| format!(".terms[{term}]")).unwrap_or_default()
    )]
    Weight {
        /// The index of the group.
        group: usize,
        /// The index of the term in it, or `None` if the weight is the group's own.
        term: Option<usize>,
        /// The weight.
        weight: f64,
    },
    /// No factor counts.
    #[error("all weights are 0: at least one factor needs a weight above 0, and its group too")]
    NoWeight,
    /// More coordinates than [`Space::MAX_COORDINATES`].
    #[error(
        "a space has at most {} coordinates, and this one has more",
        Space::MAX_COORDINATES
    )]
    TooManyCoordinates,
    /// Text that is not the text form of a space.
    #[error("space \"{text}\", column {column}: expected {expected}, found {found}")]
    Syntax {
        /// The text, cut short if it is long.
        text: String,
        /// The position in the text, in characters from 1.
        column: usize,
        /// The tokens that would be valid there.
        expected: String,
        /// The token there.
        found: String,
    },
}

/// The error of a row of numbers that is not a state of a space.
#[derive(Clone, Debug, PartialEq, Error)]
#[error("coords{}: {reason}", self.place())]
pub struct StateError {
    /// The offending coordinate's index in the row; of a quaternion whose norm is off its first; of a row of the wrong
    /// width the first that is missing or too many.
    pub coordinate: usize,
    /// The problem there.
    pub reason: StateProblem,
}

/// The problem of a coordinate, a quaternion or a row.
#[derive(Clone, Copy, Debug, PartialEq, Error)]
pub enum StateProblem {
    /// It is NaN.
    #[error("NaN")]
    NaN,
    /// It is infinite.
    #[error("infinite")]
    Infinite,
    /// It is a coordinate of a real vector above 1e150 in magnitude, whose square could overflow.
    #[error("a magnitude above 1e150, whose square could overflow")]
    TooLarge,
    /// The quaternion that begins there has this norm, and not 1 within 1 %.
    #[error(
        "the quaternion that begins here has norm {0}, not 1 within 1 %; \
         the usual cause is a shifted column or w first, the order is x, y, z, w"
    )]
    Norm(f64),
    /// The row does not have as many numbers as the space has coordinates.
    #[error("{found} numbers, where a state of this space has {expected}")]
    Width {
        /// The space's coordinates.
        expected: usize,
        /// The row's numbers.
        found: usize,
    },
    /// The coordinate is valid, and [`Space::canonicalize`] would change it.
    #[error("not in canonical form: the row has not been canonicalized for this space")]
    NotCanonical,
}

impl StateError {
    pub(super) fn new(coordinate: usize, reason: StateProblem) -> StateError {
        StateError { coordinate, reason }
    }

    pub(super) fn not_finite(coordinate: usize, value: f64) -> StateError {
        let reason = match value.is_nan() {
            true => StateProblem::NaN,
            false => StateProblem::Infinite,
        };
        StateError { coordinate, reason }
    }

    pub(super) fn width(expected: usize, found: usize) -> StateError {
        StateError::new(expected.min(found), StateProblem::Width { expected, found })
    }

    /// The error of a factor as an error of the row in which the factor begins at `offset`.
    pub(super) fn shifted(mut self, offset: usize) -> StateError {
        self.coordinate += offset;
        self
    }

    /// The index of the coordinate; nothing for a wrong width, which is an error of the row.
    fn place(&self) -> String {
        match self.reason {
            StateProblem::Width { .. } => String::new(),
            StateProblem::NaN
            | StateProblem::Infinite
            | StateProblem::TooLarge
            | StateProblem::Norm(_)
            | StateProblem::NotCanonical => format!("[{}]", self.coordinate),
        }
    }
}
