//! A frozen revision of a forest.

use std::{iter::Peekable, sync::Arc, time::Instant};

use super::{growing::GrowingTree, level::Level};
use crate::{
    Answer, Kernels, Point, Search, SearchError, Space,
    kernel::KeyMap,
    lanes::{Isa, Task},
    traversal::Traversal,
};

/// A forest as of one revision.
///
/// A snapshot shares the levels of the forest, so holding one costs nothing until merges replace those levels; from
/// then on it keeps up to a whole copy of its revision alive. In the growing tree the writer copies the parts that it
/// changes under a snapshot, and frees them at some write after the snapshot is dropped. Any number of threads may call
/// its methods.
#[derive(Clone, Debug)]
pub struct ForestSnapshot {
    pub(super) space: Arc<Space>,
    pub(super) key_map: KeyMap,
    pub(super) revision: u64,
    pub(super) live: usize,
    /// The largest first: its answers tighten the search in the others.
    pub(super) levels: Arc<Vec<Arc<Level>>>,
    /// The tree that grows by single points.
    pub(super) growing: Arc<GrowingTree>,
}

impl ForestSnapshot {
    /// The space of the states.
    pub fn space(&self) -> &Space {
        &self.space
    }

    /// The revision.
    pub fn revision(&self) -> u64 {
        self.revision
    }

    /// The number of points.
    pub fn len(&self) -> usize {
        self.live
    }

    /// True if the snapshot has no points.
    pub fn is_empty(&self) -> bool {
        self.live == 0
    }

    /// Answers `search` for a canonical `state`.
    ///
    /// # Errors
    /// The state is not a canonical state of the space ([`Space::canonicalize`]), a number of the search is out of its
    /// range, or its time passed.
    pub fn search(&self, state: &[f64], search: &Search<'_>) -> Result<Answer, SearchError> {
        self.search_with(&Kernels::default(), state, search)
    }

    /// Acts like [`ForestSnapshot::search`], with these kernels.
    ///
    /// # Errors
    /// The errors of [`ForestSnapshot::search`].
    pub fn search_with(
        &self,
        kernels: &Kernels,
        state: &[f64],
        search: &Search<'_>,
    ) -> Result<Answer, SearchError> {
        let found = kernels.run(SearchSnapshot {
            snapshot: self,
            state,
            search,
        });
        found.map(|(answer, _)| answer)
    }

    /// The number of leaves that a search visits. For tests of the trees' shape.
    ///
    /// # Errors
    /// The errors of [`ForestSnapshot::search`].
    #[doc(hidden)]
    pub fn leaves_visited(&self, state: &[f64], search: &Search<'_>) -> Result<usize, SearchError> {
        let found = Kernels::default().run(SearchSnapshot {
            snapshot: self,
            state,
            search,
        });
        found.map(|(_, leaves)| leaves)
    }

    /// A copy of the point with this id.
    pub fn get(&self, id: u64) -> Option<Point> {
        // Most calls ask for the newest points.
        if let Some(slot) = self.growing.find(id, self.revision) {
            return Some(self.growing.get(slot));
        }
        let (level, slot) = self.find_in_levels(id)?;
        Some(self.levels[level].get(slot))
    }

    /// True if a point has this id.
    pub fn contains(&self, id: u64) -> bool {
        self.growing.find(id, self.revision).is_some() || self.find_in_levels(id).is_some()
    }

    /// The index of the level that has the point with this id, and the slot in it.
    pub(super) fn find_in_levels(&self, id: u64) -> Option<(usize, usize)> {
        (0..self.levels.len())
            .rev()
            .find_map(|at| Some((at, self.levels[at].find(id, self.revision)?)))
    }

    /// Copies of the points with ids above `after` (of all points if None), by ascending id.
    pub fn points_after(&self, after: Option<u64>) -> impl Iterator<Item = Point> {
        let levels = self.levels.iter();
        let levels = levels.map(|level| level.points_after(after, self.revision));
        let growing = self.growing.points_after(after, self.revision);
        Ascending {
            parts: levels.chain([growing]).map(Iterator::peekable).collect(),
        }
    }

    /// The number of its trees, the growing one included.
    pub fn trees(&self) -> usize {
        self.levels.len() + 1
    }

    /// The number of points in levels that wait to be packed by a merge, or are being packed.
    pub fn unpacked(&self) -> usize {
        let unpacked = self.levels.iter().filter(|level| !level.is_packed());
        unpacked.map(|level| level.rows() - level.dead()).sum()
    }

    /// The time since which the first of these points wait for their merge; None if there are none.
    pub fn unpacked_since(&self) -> Option<Instant> {
        let waiting = self.levels.iter().filter_map(|it| it.unpacked_since());
        waiting.min()
    }

    /// An estimate of the bytes that the snapshot keeps alive.
    pub fn memory_bytes(&self) -> usize {
        let levels = self.levels.iter().map(|level| level.memory_bytes());
        self.growing.memory_bytes() + levels.sum::<usize>()
    }
}

/// A search of all levels, and of the growing tree last.
struct SearchSnapshot<'a> {
    snapshot: &'a ForestSnapshot,
    state: &'a [f64],
    search: &'a Search<'a>,
}

impl Task for SearchSnapshot<'_> {
    /// The answer, and the number of leaves visited.
    type Output = Result<(Answer, usize), SearchError>;

    #[inline(always)]
    fn run<I: Isa>(self) -> Self::Output {
        let snapshot = self.snapshot;
        let (space, key_map) = (&snapshot.space, &snapshot.key_map);
        self.search.check(space, self.state)?;
        let mut traversal = Traversal::new(space, key_map, self.state, self.search);
        for level in snapshot.levels.iter() {
            level.search::<I>(&mut traversal, snapshot.revision);
        }
        let growing = &snapshot.growing;
        growing.search::<I>(&mut traversal, snapshot.revision);
        Ok((traversal.finish::<I>()?, traversal.leaves_visited()))
    }
}

/// Merges the points of several trees in the order of their ids.
struct Ascending<I: Iterator> {
    parts: Vec<Peekable<I>>,
}

impl<I: Iterator<Item = Point>> Iterator for Ascending<I> {
    type Item = Point;

    fn next(&mut self) -> Option<Point> {
        let parts = self.parts.iter_mut();
        let ids = parts.map(|part| part.peek().map(|point| point.id));
        let ids = ids.enumerate().filter_map(|(at, id)| Some((id?, at)));
        let (_, least) = ids.min()?;
        self.parts[least].next()
    }
}

#[cfg(test)]
mod tests {
    use crate::{Forest, ForestOptions, Points, Space};

    #[test]
    fn the_greatest_id_is_read_after_a_level_has_ended() {
        let options = ForestOptions {
            growing_rows: 16,
            leaf_rows: 16,
        };
        let mut forest = Forest::new("R1".parse::<Space>().unwrap(), options);
        let points = |ids: &[u64]| {
            let mut points = Points::new(1);
            for &id in ids {
                points.push(id, 0, 1, &[0.5]);
            }
            points
        };
        // A mutation this large makes a level of its own.
        forest.apply(1, &points(&[1, 2, 3, 4]), &[]).unwrap();
        forest.apply(2, &points(&[u64::MAX]), &[]).unwrap();
        let snapshot = forest.snapshot();
        let ids: Vec<u64> = snapshot.points_after(None).map(|point| point.id).collect();
        assert_eq!(ids, [1, 2, 3, 4, u64::MAX]);
    }
}
