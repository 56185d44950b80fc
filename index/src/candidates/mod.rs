//! The points that may be answers, held until a search ends: [`BoundedCandidates`] by bounds of their distances,
//! [`MeasuredCandidates`] by the distances themselves.

mod bounded;
mod measured;
mod sort;

pub(crate) use bounded::{BoundedCandidates, Candidate};
pub(crate) use measured::MeasuredCandidates;

/// The greatest `k` whose candidates are kept in a sorted list.
pub(crate) const MAX_BOUNDED: usize = 40;
