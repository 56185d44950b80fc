//! The calls of a planner on an index, in any of its forms.

use std::fmt;

use crate::{Neighbor, Point, Points, Scaling, Search, Space};

/// The revision of an index that an answer read: it counts the changes in the order in which they became visible to the
/// one that answered. It means something only to the index that gave it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct ReadRevision(pub u64);

/// One point to store.
#[derive(Clone, Copy, Debug)]
pub struct NewPoint<'a> {
    /// Its id, below 2^63; None for one that the index assigns, above every id it has used.
    pub id: Option<u64>,
    /// Its tag.
    pub tag: u64,
    /// Its state: a canonical row of the space.
    pub row: &'a [f64],
    /// Its payload; empty for none.
    pub payload: &'a [u8],
}

/// A search and the factors that its number of neighbours and its radius depend on.
#[derive(Clone, Copy, Debug)]
pub struct ScaledSearch<'a> {
    /// The search. Its filter's revision is that of a [`ReadRevision`].
    pub search: Search<'a>,
    /// The factors, if `k` or the radius depends on the number of points.
    pub scaling: Scaling,
}

impl<'a> ScaledSearch<'a> {
    /// The search among `points` points of a space of this dimension.
    pub fn among(&self, points: usize, dimension: usize) -> Search<'a> {
        let mut search = self.search;
        self.scaling.apply(&mut search, points, dimension);
        search
    }
}

/// Everything that changed after some [`ReadRevision`].
#[derive(Clone, Debug, PartialEq)]
pub struct Changes {
    /// The points that were stored, and those whose tags or payloads changed, as they are now.
    pub stored: Points,
    /// The ids of the points that were removed and are not stored now.
    pub removed: Vec<u64>,
    /// The revision after these changes.
    pub read_revision: ReadRevision,
}

/// A dynamic set of points of one space, which any number of threads search and change.
///
/// Rows are canonical states of the space ([`Space::canonicalize`]); the methods refuse others. Answers are exact
/// unless epsilon is above 0, in the order (distance, id), and equal brute force in ids and in the bits of the
/// distances.
pub trait NearestNeighbors: fmt::Debug + Send + Sync {
    /// The error of a call.
    type Error;

    /// The space of the states.
    fn space(&self) -> &Space;

    /// The number of points.
    ///
    /// # Errors
    /// The index cannot be read.
    fn len(&self) -> Result<usize, Self::Error>;

    /// True if there are no points.
    ///
    /// # Errors
    /// The index cannot be read.
    fn is_empty(&self) -> Result<bool, Self::Error> {
        Ok(self.len()? == 0)
    }

    /// Finds the neighbours of `row` and puts them into `found` in place of its content.
    ///
    /// # Errors
    /// The row is not canonical, a number of the search is out of its range, the time of the search passed, or the
    /// index cannot be read.
    fn search(
        &self,
        row: &[f64],
        search: &ScaledSearch<'_>,
        found: &mut Vec<Neighbor>,
    ) -> Result<ReadRevision, Self::Error>;

    /// Finds the neighbours of many rows, which stand one after the other: an answer each, and what it has read. There is
    /// one search for all rows, or one for each.
    ///
    /// # Errors
    /// Those of [`NearestNeighbors::search`] for any row, or the index takes only one search a call.
    fn search_many(
        &self,
        rows: &[f64],
        searches: &[ScaledSearch<'_>],
    ) -> Result<Vec<(Vec<Neighbor>, ReadRevision)>, Self::Error>;

    /// Stores a point. With a search, puts what it has found among the points before it into `found`. Returns the
    /// point's id.
    ///
    /// # Errors
    /// The point is not one of the space, its id is taken, or the index cannot be written.
    fn insert(
        &self,
        point: &NewPoint<'_>,
        search: Option<&ScaledSearch<'_>>,
        found: &mut Vec<Neighbor>,
    ) -> Result<(u64, ReadRevision), Self::Error>;

    /// Stores many points with ids that the index assigns, one above the other in the order of the rows, which stand
    /// one after the other, and tag 0. Returns the ids.
    ///
    /// # Errors
    /// Those of [`NearestNeighbors::insert`]; some of the points may be stored then.
    fn insert_many(&self, rows: &[f64]) -> Result<Vec<u64>, Self::Error>;

    /// Gives a stored point another state; its tag stays, its payload goes. False if there is no such point.
    ///
    /// # Errors
    /// The row is not canonical, or the index cannot be written.
    fn replace(&self, id: u64, row: &[f64]) -> Result<bool, Self::Error>;

    /// Removes a point. False if there is no such point.
    ///
    /// # Errors
    /// The index cannot be written.
    fn remove(&self, id: u64) -> Result<bool, Self::Error>;

    /// Removes points by their ids, each named once; an id without a point has no effect.
    ///
    /// # Errors
    /// The index cannot be written; some of the points may be removed then.
    fn remove_many(&self, ids: &[u64]) -> Result<(), Self::Error> {
        ids.iter().try_for_each(|&id| self.remove(id).map(drop))
    }

    /// Sets the tag of a point. False if there is no such point.
    ///
    /// # Errors
    /// The index cannot be written.
    fn set_tag(&self, id: u64, tag: u64) -> Result<bool, Self::Error>;

    /// Sets the payload of a point. False if there is no such point.
    ///
    /// # Errors
    /// The index cannot be written.
    fn set_payload(&self, id: u64, payload: &[u8]) -> Result<bool, Self::Error>;

    /// A copy of the point with this id.
    ///
    /// # Errors
    /// The index cannot be read.
    fn get(&self, id: u64) -> Result<Option<Point>, Self::Error>;

    /// The payload of the point with this id; empty if it has none, None if there is no such point.
    ///
    /// # Errors
    /// The index cannot be read.
    fn payload(&self, id: u64) -> Result<Option<Vec<u8>>, Self::Error>;

    /// The payloads of points, in the order of the ids, each as of [`NearestNeighbors::payload`].
    ///
    /// # Errors
    /// The index cannot be read.
    fn payloads(&self, ids: &[u64]) -> Result<Vec<Option<Vec<u8>>>, Self::Error> {
        ids.iter().map(|&id| self.payload(id)).collect()
    }

    /// All points as they are at one moment, by ascending id.
    ///
    /// # Errors
    /// The index cannot be read.
    fn scan(&self) -> Result<ScannedPoints<Self::Error>, Self::Error>;

    /// Everything that changed after `since`; None if the index no longer knows.
    ///
    /// # Errors
    /// The index cannot be read.
    fn changes(&self, since: ReadRevision) -> Result<Option<Changes>, Self::Error>;

    /// Forgets all points; ids stay used.
    ///
    /// # Errors
    /// Others may use the index, or it cannot be written.
    fn clear(&self) -> Result<(), Self::Error>;
}

/// The points of a scan.
pub type ScannedPoints<E> = Box<dyn Iterator<Item = Result<Point, E>> + Send>;
