//! Tables of points.

use crate::{PointsError, Space};

/// One stored point, borrowed from the structure that holds it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PointRef<'a> {
    /// The id, unique in an index.
    pub id: u64,
    /// The tag; the planner defines its bits.
    pub tag: u64,
    /// The revision that stored its state.
    pub revision: u64,
    /// The state: a canonical row of the space.
    pub row: &'a [f64],
}

impl PointRef<'_> {
    /// A copy of the point.
    pub fn to_point(self) -> Point {
        Point {
            id: self.id,
            tag: self.tag,
            revision: self.revision,
            row: self.row.to_vec(),
        }
    }
}

/// One point, copied from the structure that stores it.
#[derive(Clone, Debug, PartialEq)]
pub struct Point {
    /// The id, unique in an index.
    pub id: u64,
    /// The tag; the planner defines its bits.
    pub tag: u64,
    /// The revision that stored its state.
    pub revision: u64,
    /// The state: a canonical row of the space.
    pub row: Vec<f64>,
}

impl Point {
    /// The point, borrowed.
    pub fn by_ref(&self) -> PointRef<'_> {
        PointRef {
            id: self.id,
            tag: self.tag,
            revision: self.revision,
            row: &self.row,
        }
    }
}

/// A table of points: ids, tags, revisions, and the rows one after the other.
///
/// ```
/// use wayfold_index::Points;
///
/// let mut points = Points::new(2);
/// points.push(7, 0, 1, &[0.5, 0.25]);
/// assert_eq!(points.get(0).row, [0.5, 0.25]);
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct Points {
    coordinates: usize,
    ids: Vec<u64>,
    tags: Vec<u64>,
    revisions: Vec<u64>,
    rows: Vec<f64>,
}

impl Points {
    /// The greatest number of points of a structure: a *slot*, a point's place in it, is 32 bits wide.
    pub const MAX_POINTS: usize = u32::MAX as usize;

    /// An empty table for rows of `coordinates` numbers.
    pub fn new(coordinates: usize) -> Self {
        Self::with_capacity(coordinates, 0)
    }

    /// An empty table with room for `rows` rows of `coordinates` numbers.
    pub fn with_capacity(coordinates: usize, rows: usize) -> Self {
        Self {
            coordinates,
            ids: Vec::with_capacity(rows),
            tags: Vec::with_capacity(rows),
            revisions: Vec::with_capacity(rows),
            rows: Vec::with_capacity(rows * coordinates),
        }
    }

    /// Appends a point.
    ///
    /// # Panics
    /// If `row` does not have the width of the table.
    pub fn push(&mut self, id: u64, tag: u64, revision: u64, row: &[f64]) {
        assert_eq!(row.len(), self.coordinates, "a row of another space");
        self.ids.push(id);
        self.tags.push(tag);
        self.revisions.push(revision);
        self.rows.extend_from_slice(row);
    }

    /// Appends a point with the row given by an iterator, instead of its own.
    pub(crate) fn push_numbers(&mut self, label: PointRef<'_>, row: impl Iterator<Item = f64>) {
        self.ids.push(label.id);
        self.tags.push(label.tag);
        self.revisions.push(label.revision);
        self.rows.extend(row);
        debug_assert_eq!(self.rows.len(), self.ids.len() * self.coordinates);
    }

    /// Appends a copy of a point.
    ///
    /// # Panics
    /// In the same cases as [`Points::push`].
    pub fn push_point(&mut self, point: PointRef<'_>) {
        self.push(point.id, point.tag, point.revision, point.row);
    }

    /// A copy with room for `rows` rows in all.
    pub(crate) fn copy_with_room(&self, rows: usize) -> Self {
        let mut copy = Self::with_capacity(self.coordinates, rows);
        copy.ids.extend_from_slice(&self.ids);
        copy.tags.extend_from_slice(&self.tags);
        copy.revisions.extend_from_slice(&self.revisions);
        copy.rows.extend_from_slice(&self.rows);
        copy
    }

    /// Removes all points and keeps their room.
    pub fn clear(&mut self) {
        self.ids.clear();
        self.tags.clear();
        self.revisions.clear();
        self.rows.clear();
    }

    /// The number of points.
    pub fn len(&self) -> usize {
        self.ids.len()
    }

    /// True if the table has no points.
    pub fn is_empty(&self) -> bool {
        self.ids.is_empty()
    }

    /// The number of coordinates in a row.
    pub fn coordinates(&self) -> usize {
        self.coordinates
    }

    /// The id of the point in `slot`.
    pub fn id(&self, slot: usize) -> u64 {
        self.ids[slot]
    }

    /// All ids, by slot.
    pub fn ids(&self) -> &[u64] {
        &self.ids
    }

    /// The tag of the point in `slot`.
    pub fn tag(&self, slot: usize) -> u64 {
        self.tags[slot]
    }

    /// The revision that stored the state in `slot`.
    pub fn revision(&self, slot: usize) -> u64 {
        self.revisions[slot]
    }

    /// The row in `slot`.
    pub fn row(&self, slot: usize) -> &[f64] {
        &self.rows[slot * self.coordinates..][..self.coordinates]
    }

    /// The point in `slot`.
    pub fn get(&self, slot: usize) -> PointRef<'_> {
        PointRef {
            id: self.ids[slot],
            tag: self.tags[slot],
            revision: self.revisions[slot],
            row: self.row(slot),
        }
    }

    /// All points, by slot.
    pub fn iter(&self) -> impl ExactSizeIterator<Item = PointRef<'_>> {
        (0..self.len()).map(|slot| self.get(slot))
    }

    /// Removes the point in `slot`; the last one takes its place.
    pub(crate) fn swap_remove(&mut self, slot: usize) {
        self.ids.swap_remove(slot);
        self.tags.swap_remove(slot);
        self.revisions.swap_remove(slot);
        let last = self.rows.len() - self.coordinates;
        self.rows.copy_within(last.., slot * self.coordinates);
        self.rows.truncate(last);
    }

    /// Checks that the rows are canonical states of `space` with distinct ids.
    pub(crate) fn check(&self, space: &Space) -> Result<(), PointsError> {
        let (expected, found) = (space.coordinates(), self.coordinates);
        if expected != found {
            return Err(PointsError::Width { expected, found });
        }
        if self.len() > Self::MAX_POINTS {
            return Err(PointsError::TooMany(self.len()));
        }
        space
            .check_all_canonical(&self.rows)
            .map_err(|(row, error)| PointsError::State { row, error })?;
        if self.ids.is_sorted_by(|a, b| a < b) {
            return Ok(());
        }
        let mut ids = self.ids.clone();
        ids.sort_unstable();
        match ids.windows(2).find(|pair| pair[0] == pair[1]) {
            Some(pair) => Err(PointsError::DuplicateId(pair[0])),
            None => Ok(()),
        }
    }

    /// The ids, tags and revisions in the order of `slots`, without rows.
    pub(crate) fn labels_in_order(&self, slots: &[u32]) -> Self {
        let ordered = |column: &[u64]| slots.iter().map(|&slot| column[slot as usize]).collect();
        Self {
            coordinates: 0,
            ids: ordered(&self.ids),
            tags: ordered(&self.tags),
            revisions: ordered(&self.revisions),
            rows: Vec::new(),
        }
    }

    /// The newest revision; 0 without points.
    pub(crate) fn newest(&self) -> u64 {
        self.revisions.iter().copied().max().unwrap_or(0)
    }

    /// The bytes that the columns hold.
    pub(crate) fn memory_bytes(&self) -> usize {
        8 * (self.ids.capacity()
            + self.tags.capacity()
            + self.revisions.capacity()
            + self.rows.capacity())
    }
}
