//! One frozen revision, and its searches.

use std::time::Instant;

use wayfold_index::{Filter, Neighbor, Point, SearchError, Snapshot};

use super::load::protocol;
use super::validate::{canonical, check};
use crate::{
    Error, IndexHandle, Radius, ReplicaSearch, Revision, State, States,
    search::{Bounds, K},
};

/// One revision of an index, frozen. Clones are cheap.
#[derive(Clone, Debug)]
pub struct ReplicaView {
    index: IndexHandle,
    points: Snapshot,
}

/// The neighbours of one state, as a replica finds them: nearest first, at equal distances by id. They are read like a
/// [`Row`](crate::Row) of the server's answer.
#[derive(Clone, Debug, PartialEq)]
pub struct ReplicaNeighbors {
    neighbors: Vec<Neighbor>,
    revision: Revision,
}

impl ReplicaNeighbors {
    /// The number of neighbours.
    pub fn len(&self) -> usize {
        self.neighbors.len()
    }

    /// True if there are none.
    pub fn is_empty(&self) -> bool {
        self.neighbors.is_empty()
    }

    /// The nearest neighbour.
    pub fn nearest(&self) -> Option<Neighbor> {
        self.neighbors.first().copied()
    }

    /// The ids, nearest first.
    pub fn ids(&self) -> impl ExactSizeIterator<Item = u64> + use<'_> {
        self.iter().map(|neighbor| neighbor.id)
    }

    /// The distances in the space's metric, ascending.
    pub fn distances(&self) -> impl ExactSizeIterator<Item = f64> + use<'_> {
        self.iter().map(|neighbor| neighbor.distance)
    }

    /// The id and distance of each neighbour, nearest first.
    pub fn iter(&self) -> impl ExactSizeIterator<Item = Neighbor> + use<'_> {
        self.neighbors.iter().copied()
    }

    /// The id and distance of each neighbour, nearest first, without a copy.
    pub fn into_vec(self) -> Vec<Neighbor> {
        self.neighbors
    }

    /// The revision that was searched.
    pub fn revision(&self) -> Revision {
        self.revision.clone()
    }
}

impl ReplicaView {
    pub(super) fn new(index: IndexHandle, points: Snapshot) -> ReplicaView {
        ReplicaView { index, points }
    }

    pub(super) fn index(&self) -> &IndexHandle {
        &self.index
    }

    /// The revision.
    pub fn revision(&self) -> Revision {
        self.index.revision_at(self.points.revision())
    }

    /// The number of points.
    pub fn len(&self) -> usize {
        self.points.len()
    }

    /// True if there are none.
    pub fn is_empty(&self) -> bool {
        self.points.is_empty()
    }

    /// A copy of the point with this id.
    pub fn get(&self, id: u64) -> Option<Point> {
        self.points.get(id)
    }

    /// The `k` nearest points.
    ///
    /// # Errors
    /// The errors of [`ReplicaView::search`].
    pub fn knn(&self, state: impl State, k: u32) -> Result<ReplicaNeighbors, Error> {
        self.search(state, &ReplicaSearch::k(k))
    }

    /// All points at distance `radius` or nearer, the closed ball: a number, or a
    /// [`ScaledRadius`](crate::ScaledRadius).
    ///
    /// # Errors
    /// The errors of [`ReplicaView::search`].
    pub fn query(
        &self,
        state: impl State,
        radius: impl Into<Radius>,
    ) -> Result<ReplicaNeighbors, Error> {
        self.search(state, &ReplicaSearch::within(radius))
    }

    /// Answers any search, as the server would at this revision.
    ///
    /// # Errors
    /// The errors of [`Replica::search`](super::Replica::search), except that a view does not grow stale.
    pub fn search<S: State>(
        &self,
        state: S,
        search: &ReplicaSearch,
    ) -> Result<ReplicaNeighbors, Error> {
        let states = States::collect(self.index.space(), [state])?;
        let state = canonical(self.index.space(), states, check(search))?;
        let revision = self.revision();
        let since = match &search.filter.since {
            None => 0,
            Some(since) => {
                since.check_uid(&revision.uid)?;
                since.number
            }
        };
        if since > revision.number {
            return Err(Error::Behind {
                since,
                revision: revision.number,
            });
        }
        let answer = self
            .points
            .search(&state, &self.plain(search, since))
            .map_err(|error| match (error, search.timeout) {
                (SearchError::TimedOut, Some(timeout)) => Error::timeout("search", timeout),
                (error, _) => protocol(error.to_string()),
            })?;
        Ok(ReplicaNeighbors {
            neighbors: answer.neighbors,
            revision,
        })
    }

    /// The search in the index's terms, its factors evaluated.
    fn plain(&self, search: &ReplicaSearch, since_revision: u64) -> wayfold_index::Search<'static> {
        let Bounds { k, radius } = search.bounds;
        let k = match k {
            Some(K::Fixed(k)) => k as usize,
            Some(K::Scaled(_)) | None => usize::MAX,
        };
        let mut plain = wayfold_index::Search::nearest_k(k);
        if let Some(Radius::Fixed(radius)) = radius {
            plain.radius = radius;
        }
        plain.epsilon = search.epsilon;
        plain.until = search
            .timeout
            .and_then(|timeout| Instant::now().checked_add(timeout));
        plain.filter = Filter {
            tag_mask: search.filter.tag_mask,
            tag_value: search.filter.tag_value,
            since_revision,
        };
        let dimension = self.index.space().dimension();
        search
            .bounds
            .scaling()
            .apply(&mut plain, self.len(), dimension);
        plain
    }
}
