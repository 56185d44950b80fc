//! One frozen revision, and searching it.

use std::sync::Arc;

use wayfold_index::{Neighbor, Point, Scaling, Search, Snapshot};

use super::load::protocol;
use super::refused::{canonical, check, check_scaling};
use crate::{Error, IndexHandle, State, States};

/// One revision of an index, frozen. Clones are cheap.
#[derive(Clone, Debug)]
pub struct ReplicaView {
    index: IndexHandle,
    uid: Arc<str>,
    points: Snapshot,
}

/// What a replica found.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub struct Found {
    /// The neighbours, nearest first; at equal distances by id.
    pub neighbors: Vec<Neighbor>,
    /// Whether they equal brute force: false only if `epsilon`, `max_leaves` or `until` may have cost an answer.
    pub exact: bool,
    /// The revision that was searched.
    pub revision: u64,
    /// The uid of the index, to which the revision belongs.
    pub uid: Arc<str>,
}

impl ReplicaView {
    pub(super) fn new(index: IndexHandle, uid: Arc<str>, points: Snapshot) -> ReplicaView {
        ReplicaView { index, uid, points }
    }

    pub(super) fn index(&self) -> &IndexHandle {
        &self.index
    }

    /// The revision.
    pub fn revision(&self) -> u64 {
        self.points.revision()
    }

    /// The uid of the index, to which the revision belongs.
    pub fn uid(&self) -> &str {
        &self.uid
    }

    /// How many points there are.
    pub fn len(&self) -> usize {
        self.points.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.points.is_empty()
    }

    /// A copy of the point with this id.
    pub fn get(&self, id: u64) -> Option<Point> {
        self.points.get(id)
    }

    /// The nearest point, if there is one.
    ///
    /// # Errors
    /// As [`ReplicaView::search`].
    pub fn nearest(&self, state: impl State) -> Result<Found, Error> {
        self.nearest_k(state, 1)
    }

    /// The `k` nearest points.
    ///
    /// # Errors
    /// As [`ReplicaView::search`].
    pub fn nearest_k(&self, state: impl State, k: usize) -> Result<Found, Error> {
        self.search(state, &Search::nearest_k(k))
    }

    /// All points at distance `radius` or nearer, the closed ball.
    ///
    /// # Errors
    /// As [`ReplicaView::search`].
    pub fn nearest_r(&self, state: impl State, radius: f64) -> Result<Found, Error> {
        self.search(state, &Search::nearest_r(radius))
    }

    /// Answers a search whose number and radius are scaled by how many points there are, as the server would.
    ///
    /// # Errors
    /// As [`ReplicaView::search`], and `INVALID_ARGUMENT` naming the factor.
    pub fn search_scaled<S: State>(
        &self,
        state: S,
        scaling: Scaling,
        search: &Search<'_>,
    ) -> Result<Found, Error> {
        check_scaling(scaling)?;
        let mut search = *search;
        scaling.apply(&mut search, self.len(), self.index.space().dimension());
        self.search(state, &search)
    }

    /// Answers any search.
    ///
    /// # Errors
    /// As [`Replica::search`](super::Replica::search), but that a view does not grow stale.
    pub fn search<S: State>(&self, state: S, search: &Search<'_>) -> Result<Found, Error> {
        let states = States::collect(self.index.space(), [state])?;
        let state = canonical(self.index.space(), states, check(search))?;
        let (since, revision) = (search.filter.since_revision, self.revision());
        if since > revision {
            return Err(Error::Behind {
                asked: since,
                revision,
            });
        }
        let answer = self
            .points
            .search(&state, search)
            .map_err(|error| protocol(error.to_string()))?;
        Ok(Found {
            neighbors: answer.neighbors,
            exact: answer.exact,
            revision,
            uid: Arc::clone(&self.uid),
        })
    }
}
