//! The options and answers of an [`Index`](crate::Index).

use wayfold_index::{Neighbor, NewPoint, ReadRevision};

use super::Search;
use crate::{Error, FromState};

/// One stored point.
#[derive(Clone, Debug, PartialEq)]
pub struct StoredPoint {
    /// Its id.
    pub id: u64,
    /// Its tag.
    pub tag: u64,
    /// Its state, in canonical form.
    pub state: Vec<f64>,
}

impl StoredPoint {
    /// The state as a type of the same number of coordinates; `None` if the numbers differ.
    pub fn state_as<S: FromState>(&self) -> Option<S> {
        S::from_state(&self.state)
    }
}

impl From<wayfold_index::Point> for StoredPoint {
    fn from(point: wayfold_index::Point) -> StoredPoint {
        StoredPoint {
            id: point.id,
            tag: point.tag,
            state: point.row,
        }
    }
}

/// The neighbours of a state, nearest first and at equal distances by id.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SearchResult {
    /// The neighbours.
    pub neighbors: Vec<Neighbor>,
    /// The revision that the answer read: a later search or insert may ask for the points after it ([`Search::since`]).
    pub read_revision: ReadRevision,
}

impl SearchResult {
    /// The ids of the neighbours.
    pub fn ids(&self) -> impl ExactSizeIterator<Item = u64> {
        self.iter().map(|neighbor| neighbor.id)
    }

    /// The distances of the neighbours.
    pub fn distances(&self) -> impl ExactSizeIterator<Item = f64> {
        self.iter().map(|neighbor| neighbor.distance)
    }

    /// The nearest neighbour.
    pub fn nearest(&self) -> Option<Neighbor> {
        self.neighbors.first().copied()
    }

    /// All neighbours.
    pub fn iter(&self) -> impl ExactSizeIterator<Item = Neighbor> {
        self.neighbors.iter().copied()
    }
}

/// The tag, the payload and the id that an insert stores with a state, and the search of its neighbours.
///
/// ```
/// use wayfold::{InsertOptions, Search};
///
/// let options = InsertOptions::new().tag(1).payload(b"parent 17").neighbors(Search::k(10));
/// ```
#[derive(Clone, Copy, Debug, Default)]
pub struct InsertOptions<'a> {
    id: Option<u64>,
    tag: u64,
    payload: &'a [u8],
    pub(super) search: Option<Search>,
}

impl<'a> InsertOptions<'a> {
    /// An id that the index assigns, tag 0, no payload, no search.
    pub fn new() -> InsertOptions<'a> {
        InsertOptions::default()
    }

    /// This id, below 2^63. The insert fails if a point has it, or if a shared index has got it from the server for its own
    /// points, even if it has removed the point that it gave it to.
    ///
    /// A shared index looks in its copy: of two processes that store the same id at once, the later one replaces the
    /// point. Ids in a block that the server reserved for another process are refused, which ends the writes of this
    /// one until [`Index::take_unsent`](crate::Index::take_unsent). Choose a range above all assigned ids, well below
    /// 2^63, then store and flush its last id first: the server assigns only greater ids from then on, and the ids
    /// below it stay the caller's.
    pub fn id(mut self, id: u64) -> InsertOptions<'a> {
        self.id = Some(id);
        self
    }

    /// A tag, whose bits the planner defines.
    pub fn tag(mut self, tag: u64) -> InsertOptions<'a> {
        self.tag = tag;
        self
    }

    /// A payload, of at most 64 KiB in an index of a server.
    pub fn payload(mut self, payload: &'a [u8]) -> InsertOptions<'a> {
        self.payload = payload;
        self
    }

    /// Asks for the neighbours that the point has at its insertion: of any two points, the later one finds the earlier.
    /// A shared index answers from its copy, and scales `k` and the radius by the size of the copy.
    /// [`Index::meanwhile`](crate::Index::meanwhile) later names the other neighbours among all points before this one.
    /// A remote index does not end this search by its [timeout](Search::timeout), but by that of the call.
    pub fn neighbors(mut self, search: Search) -> InsertOptions<'a> {
        self.search = Some(search);
        self
    }

    pub(super) fn point(&self, row: &'a [f64]) -> NewPoint<'a> {
        NewPoint {
            id: self.id,
            tag: self.tag,
            row,
            payload: self.payload,
        }
    }
}

/// An insert's id, and what it found.
#[derive(Clone, Debug, PartialEq)]
pub struct InsertedPoint {
    /// The point's id.
    pub id: u64,
    /// The neighbours that [`InsertOptions::neighbors`] asked for.
    pub neighbors: SearchResult,
}

/// Everything that changed in an index after an earlier answer.
#[derive(Clone, Debug, PartialEq)]
pub struct Changes {
    /// The points that were stored or moved, or got another tag or payload, as they are now.
    pub stored: Vec<StoredPoint>,
    /// The ids of the points that were removed.
    pub removed: Vec<u64>,
    /// The revision after these changes.
    pub read_revision: ReadRevision,
}

/// All points of an index, as they were when the scan began, by ascending id.
pub struct StoredPoints(pub(super) wayfold_index::ScannedPoints<Error>);

impl Iterator for StoredPoints {
    type Item = Result<StoredPoint, Error>;

    fn next(&mut self) -> Option<Result<StoredPoint, Error>> {
        Some(self.0.next()?.map(StoredPoint::from))
    }
}

impl std::fmt::Debug for StoredPoints {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("StoredPoints").finish_non_exhaustive()
    }
}
