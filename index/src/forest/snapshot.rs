//! One frozen revision of a forest.

use std::sync::Arc;

use super::{buffer::Buffer, level::Level};
use crate::{
    Answer, Kernels, PointRef, Search, Space,
    kernel::{Set, Task},
    search::Walk,
};

/// A forest as it stood at one revision, for as long as it is held.
///
/// It shares the levels with the forest by count, so holding one costs nothing until merges replace those levels: then
/// it keeps up to a whole copy of its revision alive. The small buffer is copied by the writer when it changes it
/// under a snapshot. All methods may be called from any number of threads.
#[derive(Clone, Debug)]
pub struct Snapshot {
    pub(super) space: Arc<Space>,
    pub(super) revision: u64,
    pub(super) live: usize,
    /// Largest first: the first answers tighten the search in the rest.
    pub(super) levels: Arc<Vec<Arc<Level>>>,
    /// The points that are in no level yet, all alive.
    pub(super) buffer: Arc<Buffer>,
}

impl Snapshot {
    /// The space of the states.
    pub fn space(&self) -> &Space {
        &self.space
    }

    /// The revision it shows.
    pub fn revision(&self) -> u64 {
        self.revision
    }

    /// How many points it has.
    pub fn len(&self) -> usize {
        self.live
    }

    /// Whether it has none.
    pub fn is_empty(&self) -> bool {
        self.live == 0
    }

    /// Answers `search` for a canonical `state`.
    pub fn search(&self, state: &[f64], search: &Search<'_>) -> Answer {
        self.search_with(&Kernels::default(), state, search)
    }

    /// As [`Snapshot::search`], with these kernels.
    pub fn search_with(&self, kernels: &Kernels, state: &[f64], search: &Search<'_>) -> Answer {
        kernels.run(SearchSnapshot {
            snapshot: self,
            state,
            search,
        })
    }

    /// The point with this id.
    pub fn get(&self, id: u64) -> Option<PointRef<'_>> {
        let recent = self.buffer.points();
        if let Some(slot) = recent.ids().iter().position(|&held| held == id) {
            return Some(recent.get(slot));
        }
        let (level, slot) = self.find_in_levels(id)?;
        Some(self.levels[level].get(slot))
    }

    /// The place of a level and the slot in it.
    pub(super) fn find_in_levels(&self, id: u64) -> Option<(usize, usize)> {
        // The newest points are asked about most, and lie in the small levels at the end.
        (0..self.levels.len())
            .rev()
            .find_map(|at| Some((at, self.levels[at].find(id, self.revision)?)))
    }

    /// The points with ids above `after` (all points if None), by ascending id.
    pub fn points_after(&self, after: Option<u64>) -> impl Iterator<Item = PointRef<'_>> {
        let mut recent: Vec<PointRef<'_>> = self
            .buffer
            .points()
            .iter()
            .filter(|point| after.is_none_or(|after| point.id > after))
            .collect();
        recent.sort_unstable_by_key(|point| std::cmp::Reverse(point.id));
        let mut ascending = Ascending {
            revision: self.revision,
            cursors: Vec::with_capacity(self.levels.len()),
            recent,
        };
        for level in self.levels.iter() {
            let slots = level.slots_after(after);
            ascending
                .cursors
                .extend(Cursor::new(level, slots, self.revision));
        }
        ascending
    }

    /// An estimate of the bytes it keeps alive.
    pub fn memory_bytes(&self) -> usize {
        self.buffer.memory_bytes()
            + self
                .levels
                .iter()
                .map(|level| level.memory_bytes())
                .sum::<usize>()
    }
}

/// The search of all levels and the buffer.
struct SearchSnapshot<'a> {
    snapshot: &'a Snapshot,
    state: &'a [f64],
    search: &'a Search<'a>,
}

impl Task for SearchSnapshot<'_> {
    type Output = Answer;

    #[inline(always)]
    fn run<S: Set>(self) -> Answer {
        let snapshot = self.snapshot;
        let mut walk = Walk::new(&snapshot.space, self.state, self.search);
        for level in snapshot.levels.iter() {
            level.visit::<S>(&mut walk, snapshot.revision);
        }
        snapshot.buffer.visit::<S>(&mut walk);
        walk.finish()
    }
}

/// A level's next visible point, and the slots that follow it.
struct Cursor<'a> {
    level: &'a Level,
    next: PointRef<'a>,
    rest: &'a [u32],
}

impl<'a> Cursor<'a> {
    fn new(level: &'a Level, slots: &'a [u32], revision: u64) -> Option<Self> {
        let at = slots
            .iter()
            .position(|&slot| level.sees(slot as usize, revision))?;
        Some(Self {
            level,
            next: level.get(slots[at] as usize),
            rest: &slots[at + 1..],
        })
    }
}

/// Merges the levels and the buffer in the order of the ids.
struct Ascending<'a> {
    revision: u64,
    cursors: Vec<Cursor<'a>>,
    /// The buffer's points, the least id last.
    recent: Vec<PointRef<'a>>,
}

impl<'a> Iterator for Ascending<'a> {
    type Item = PointRef<'a>;

    fn next(&mut self) -> Option<PointRef<'a>> {
        let least = (0..self.cursors.len()).min_by_key(|&at| self.cursors[at].next.id);
        let Some(at) = least else {
            return self.recent.pop();
        };
        let cursor = &self.cursors[at];
        if self
            .recent
            .last()
            .is_some_and(|point| point.id < cursor.next.id)
        {
            return self.recent.pop();
        }
        let point = cursor.next;
        match Cursor::new(cursor.level, cursor.rest, self.revision) {
            Some(cursor) => self.cursors[at] = cursor,
            None => {
                self.cursors.swap_remove(at);
            }
        }
        Some(point)
    }
}
