//! Brute force: the structure for a handful of points, and the oracle of the others.

use std::collections::HashMap;

use crate::{Answer, Neighbor, PointRef, Points, Search, SearchError, Space, StateError};

/// A table of points, searched from end to end.
///
/// ```
/// use wayfold_index::{Linear, PointRef, Search, Space};
///
/// let mut points = Linear::new("SO2[1]".parse()?);
/// for (id, angle) in [(1, -0.45), (2, 0.0), (3, 0.45)] {
///     points.insert(PointRef { id, tag: 0, revision: 1, row: &[angle] })?;
/// }
/// // Across the seam, -0.45 and 0.45 are neighbours.
/// let answer = points.search(&[0.45], &Search::nearest_k(2))?;
/// assert_eq!([answer.neighbors[0].id, answer.neighbors[1].id], [3, 1]);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Clone, Debug)]
pub struct Linear {
    space: Space,
    points: Points,
    slots: HashMap<u64, usize>,
}

impl Linear {
    /// An empty table of states of `space`.
    pub fn new(space: Space) -> Self {
        Self {
            points: Points::new(space.coordinates()),
            slots: HashMap::new(),
            space,
        }
    }

    /// The space of the states.
    pub fn space(&self) -> &Space {
        &self.space
    }

    /// Stores a point, in the place of one with the same id.
    ///
    /// # Errors
    /// The row is not a canonical state of the space ([`Space::canonicalize`]); nothing is changed then.
    pub fn insert(&mut self, point: PointRef<'_>) -> Result<(), StateError> {
        self.space.check_canonical(point.row)?;
        self.remove(point.id);
        self.slots.insert(point.id, self.points.len());
        self.points.push_point(point);
        Ok(())
    }

    /// Removes a point; false if there was none with this id.
    pub fn remove(&mut self, id: u64) -> bool {
        let Some(slot) = self.slots.remove(&id) else {
            return false;
        };
        self.points.swap_remove(slot);
        if slot < self.points.len() {
            self.slots.insert(self.points.id(slot), slot);
        }
        true
    }

    /// The point with this id.
    pub fn get(&self, id: u64) -> Option<PointRef<'_>> {
        self.slots.get(&id).map(|&slot| self.points.get(slot))
    }

    /// The number of points.
    pub fn len(&self) -> usize {
        self.points.len()
    }

    /// True if the table has no points.
    pub fn is_empty(&self) -> bool {
        self.points.is_empty()
    }

    /// All points, in no particular order.
    pub fn iter(&self) -> impl ExactSizeIterator<Item = PointRef<'_>> {
        self.points.iter()
    }

    /// Answers `search` for a canonical `state` exactly, whatever its epsilon and its time.
    ///
    /// # Errors
    /// The state is not a canonical state of the space, or a number of the search is out of its range.
    pub fn search(&self, state: &[f64], search: &Search<'_>) -> Result<Answer, SearchError> {
        search.check(&self.space, state)?;
        let admitted = self.points.iter().filter(|point| {
            search.filter.admits(point.tag, point.revision) && !search.excludes(point.id)
        });
        let measured = admitted.map(|point| Neighbor {
            distance: self.space.distance(state, point.row),
            id: point.id,
        });
        let mut neighbors: Vec<Neighbor> = measured
            .filter(|neighbor| neighbor.distance <= search.radius)
            .collect();
        if search.k < neighbors.len() {
            neighbors.select_nth_unstable(search.k);
            neighbors.truncate(search.k);
        }
        neighbors.sort_unstable();
        Ok(Answer { neighbors })
    }
}
