//! A search request and its answer.

use std::{collections::HashSet, time::Instant};

use crate::{Neighbor, SearchError, Space};

/// Limits a search to some of the points. The default admits every point.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Filter {
    /// Admits points with `tag & tag_mask == tag_value`.
    pub tag_mask: u64,
    /// The value that the masked tag must have.
    pub tag_value: u64,
    /// Admits points whose state was stored after this revision.
    pub since_revision: u64,
}

impl Filter {
    /// True if a point with this tag and revision passes.
    pub fn admits(&self, tag: u64, revision: u64) -> bool {
        tag & self.tag_mask == self.tag_value
            && (self.since_revision == 0 || revision > self.since_revision)
    }
}

/// A search around one state: for the `k` nearest points, for the points within a closed radius, or for both at once.
#[derive(Clone, Copy, Debug)]
pub struct Search<'a> {
    /// The greatest number of neighbours; `usize::MAX` for no limit.
    pub k: usize,
    /// The greatest distance of a neighbour; infinity for no limit.
    pub radius: f64,
    /// An answer may be farther than the true one by a factor of `1 + epsilon`, and points between
    /// `radius / (1 + epsilon)` and the radius may be missing. With 0 the answer is exact.
    pub epsilon: f64,
    /// The search fails with [`SearchError::TimedOut`] soon after this time: within 32 leaves, or 32 blocks of points
    /// of a larger leaf.
    pub until: Option<Instant>,
    /// Limits the search to some of the points.
    pub filter: Filter,
    /// Leaves out the points whose ids are in one of these sets.
    pub excluded: &'a [&'a HashSet<u64>],
}

impl Search<'_> {
    /// A search for the `k` nearest points.
    pub fn nearest_k(k: usize) -> Self {
        Self {
            k,
            radius: f64::INFINITY,
            epsilon: 0.0,
            until: None,
            filter: Filter::default(),
            excluded: &[],
        }
    }

    /// A search for all points at distance `radius` or less.
    pub fn nearest_r(radius: f64) -> Self {
        Self {
            radius,
            ..Self::nearest_k(usize::MAX)
        }
    }

    /// True if the point with this id is left out.
    #[inline]
    pub(crate) fn excludes(&self, id: u64) -> bool {
        self.excluded.iter().any(|ids| ids.contains(&id))
    }

    /// Checks that the search can be answered for `state` in `space`.
    #[inline]
    pub(crate) fn check(&self, space: &Space, state: &[f64]) -> Result<(), SearchError> {
        space.check_canonical(state)?;
        if self.radius.is_nan() {
            return Err(SearchError::Radius);
        }
        if !(0.0..f64::INFINITY).contains(&self.epsilon) {
            return Err(SearchError::Epsilon(self.epsilon));
        }
        Ok(())
    }
}

/// The answer to a search.
#[derive(Clone, Debug, PartialEq)]
pub struct Answer {
    /// The neighbours, in the order (distance, id).
    pub neighbors: Vec<Neighbor>,
}
