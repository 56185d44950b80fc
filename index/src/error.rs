//! The errors of structures: refused points, mutations and searches.

use thiserror::Error;

use crate::StateError;

/// The error of a table of points.
#[derive(Clone, Debug, PartialEq, Error)]
pub enum PointsError {
    /// The rows are of another space.
    #[error("rows of {found} numbers, where the space has {expected} coordinates")]
    Width {
        /// The space's coordinates.
        expected: usize,
        /// The coordinates of the rows.
        found: usize,
    },
    /// There are more than [`Points::MAX_POINTS`](crate::Points::MAX_POINTS).
    #[error("{0} points, where a structure holds at most {max}", max = u32::MAX)]
    TooMany(usize),
    /// A row is not a canonical state of the space.
    #[error("states[{row}].{error}")]
    State {
        /// The index of the row in the table.
        row: usize,
        /// The problem of the row.
        error: StateError,
    },
    /// Two points have the same id.
    #[error("id {0} stands twice among the points")]
    DuplicateId(u64),
}

/// The error of a mutation, which changed nothing.
#[derive(Clone, Debug, PartialEq, Error)]
pub enum ApplyError {
    /// The revision is not above the forest's, or is `u64::MAX`.
    #[error("revision {revision} for a forest at {head}: it is above that and below u64::MAX")]
    Revision {
        /// The mutation's revision.
        revision: u64,
        /// The forest's.
        head: u64,
    },
    /// The points to store are not points of the forest's space.
    #[error(transparent)]
    Points(#[from] PointsError),
}

/// The error of a search.
#[derive(Clone, Debug, PartialEq, Error)]
pub enum SearchError {
    /// The state is not a canonical state of the space.
    #[error("state: {0}")]
    State(#[from] StateError),
    /// The radius is NaN.
    #[error("radius: NaN")]
    Radius,
    /// Epsilon is NaN, infinite or negative.
    #[error("epsilon {0}: it is finite and at least 0")]
    Epsilon(f64),
    /// The time of [`Search::until`](crate::Search::until) passed before the search ended.
    #[error("the search did not end in time")]
    TimedOut,
}
