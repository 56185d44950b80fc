//! The dynamic structure: a forest of static trees, by the logarithmic method.
//!
//! New points go to a small buffer, searched from end to end. A full buffer becomes a *level*, and levels are merged
//! into ones of doubling size, and into a single one when writes pause ([`policy`]), which builds their trees and drops
//! their dead. Removing a point of a level marks it with a *tombstone*; replacing one removes it and stores it anew.
//!
//! One owner writes; any number of [`Snapshot`]s read, each at its own revision, and neither waits for the other:
//! levels are immutable and shared by count, tombstones are judged by revision, and the buffer is copied if a snapshot
//! holds it when it changes. Merges run wherever the owner likes: [`Forest::begin_merge`] says what is due,
//! [`Merge::run`] does the work, [`Forest::finish_merge`] swaps the result in, while mutations and searches go on. No
//! call of the forest but [`Forest::settle`] does more than its own share of work.

mod buffer;
mod level;
mod merge;
mod policy;
mod snapshot;
mod tombstones;
mod validate;

use std::sync::Arc;

use crate::{Answer, KdTree, PointRef, Points, Search, Space};
use buffer::Buffer;
use level::Level;
use merge::Running;
pub use merge::{Merge, Merged};
pub use snapshot::Snapshot;

/// The sizes a forest is built with.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ForestOptions {
    /// How many points gather before they become a level.
    pub buffer_rows: usize,
    /// Most points of a leaf.
    pub leaf_rows: usize,
}

impl Default for ForestOptions {
    fn default() -> Self {
        Self {
            buffer_rows: 128,
            leaf_rows: 16,
        }
    }
}

/// A dynamic set of points of one space with exact nearest-neighbour search.
///
/// ```
/// use wayfold_index::{Forest, ForestOptions, Points, Search, Space};
///
/// let mut forest = Forest::new(Space::se2(), ForestOptions::default());
/// let mut points = Points::new(3);
/// points.push(1, 0, 1, &[0.0, 0.0, 0.0]);
/// points.push(2, 0, 1, &[1.0, 0.0, 0.0]);
/// forest.apply(1, &points, &[]);
/// let before = forest.snapshot();
/// forest.apply(2, &Points::new(3), &[1]);
/// assert_eq!(forest.search(&[0.0; 3], &Search::nearest_k(1)).neighbors[0].id, 2);
/// assert_eq!(before.search(&[0.0; 3], &Search::nearest_k(1)).neighbors[0].id, 1);
/// ```
#[derive(Debug)]
pub struct Forest {
    options: ForestOptions,
    /// The newest revision; a snapshot is a clone of it.
    head: Snapshot,
    running: Vec<Running>,
    next_token: u64,
    /// The revision during which a whole merge has passed: whoever writes makes a pause of about that length.
    quiet_at: Option<u64>,
}

impl Forest {
    /// An empty forest at revision 0.
    pub fn new(space: Space, options: ForestOptions) -> Self {
        let options = ForestOptions {
            buffer_rows: options.buffer_rows.max(1),
            leaf_rows: options.leaf_rows.max(1),
        };
        let buffer = Buffer::new(space.coordinates());
        let head = Snapshot {
            space: Arc::new(space),
            revision: 0,
            live: 0,
            levels: Arc::default(),
            buffer: Arc::new(buffer),
        };
        Self {
            options,
            head,
            running: Vec::new(),
            next_token: 0,
            quiet_at: None,
        }
    }

    /// The space of the states.
    pub fn space(&self) -> &Space {
        &self.head.space
    }

    /// How many points there are.
    pub fn len(&self) -> usize {
        self.head.live
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.head.is_empty()
    }

    /// The last revision that was applied.
    pub fn revision(&self) -> u64 {
        self.head.revision
    }

    /// The point with this id.
    pub fn get(&self, id: u64) -> Option<PointRef<'_>> {
        self.head.get(id)
    }

    /// Answers `search` for a canonical `state` at the head.
    pub fn search(&self, state: &[f64], search: &Search<'_>) -> Answer {
        self.head.search(state, search)
    }

    /// The head, frozen.
    pub fn snapshot(&self) -> Snapshot {
        self.head.clone()
    }

    /// An estimate of the bytes it holds, not counting what only snapshots keep alive.
    pub fn memory_bytes(&self) -> usize {
        self.head.memory_bytes()
    }

    /// Applies one mutation as `revision`: removes the points with the ids `removed`, then stores the canonical rows
    /// `stored`, in the place of points with the same ids. Returns how many of `removed` were there.
    ///
    /// # Panics
    /// If `revision` is not above the forest's (the caller lost count), or the rows are of another width or more than
    /// [`KdTree::MAX_POINTS`].
    pub fn apply(&mut self, revision: u64, stored: &Points, removed: &[u64]) -> usize {
        assert!(
            revision > self.head.revision,
            "revision {revision} after {}",
            self.head.revision
        );
        assert_eq!(stored.coordinates(), self.head.space.coordinates());
        // First, so that what this mutation has removed already is dead to its own look-ups.
        self.head.revision = revision;
        let found = removed
            .iter()
            .filter(|&&id| self.remove(id, revision))
            .count();
        for &id in stored.ids() {
            self.remove(id, revision);
        }
        self.store(stored);
        found
    }

    /// Removes the point with this id as of `revision`; false if there is none.
    fn remove(&mut self, id: u64, revision: u64) -> bool {
        let head = &mut self.head;
        let buffered = head.buffer.points().ids();
        if let Some(slot) = buffered.iter().position(|&held| held == id) {
            writable(&mut head.buffer, self.options.buffer_rows).swap_remove(slot);
        } else if let Some((at, slot)) = head.find_in_levels(id) {
            let level = &head.levels[at];
            level.bury(slot, revision);
            if let Some(running) = self.running.iter_mut().find(|running| running.has(level)) {
                running.buried.push((id, revision));
            }
        } else {
            return false;
        }
        head.live -= 1;
        true
    }

    /// Stores rows whose ids are not in the forest.
    fn store(&mut self, rows: &Points) {
        self.head.live += rows.len();
        if rows.len() >= self.options.buffer_rows {
            // A level of its own: the buffer would only copy it in pieces.
            self.add_level(Level::unbuilt(Arc::clone(&self.head.space), rows.clone()));
            return;
        }
        for point in rows.iter() {
            let buffer = writable(&mut self.head.buffer, self.options.buffer_rows);
            buffer.push(point);
            if buffer.points().len() >= self.options.buffer_rows {
                let empty = Buffer::new(rows.coordinates());
                let full = std::mem::replace(buffer, empty).into_points();
                self.add_level(Level::unbuilt(Arc::clone(&self.head.space), full));
            }
        }
    }

    fn add_level(&mut self, level: Level) {
        let levels = Arc::make_mut(&mut self.head.levels);
        let at = levels.partition_point(|held| held.rows() >= level.rows());
        levels.insert(at, Arc::new(level));
    }

    /// The next merge that is due, or None. The forest works on as before until it is finished; further merges may
    /// begin meanwhile, of other levels. While no one writes, levels are merged until one is left.
    pub fn begin_merge(&mut self) -> Option<Merge> {
        let shapes = self.shapes();
        let due = self.due(&shapes).or_else(|| {
            let quiet = self.quiet_at == Some(self.head.revision);
            quiet
                .then(|| policy::next_while_quiet(&shapes, KdTree::MAX_POINTS))
                .flatten()
        })?;
        Some(self.begin(&due))
    }

    fn due(&self, shapes: &[policy::Shape]) -> Option<Vec<usize>> {
        policy::next_merge(shapes, self.options.buffer_rows, KdTree::MAX_POINTS)
    }

    fn shapes(&self) -> Vec<policy::Shape> {
        let shape = |level: &Arc<Level>| policy::Shape {
            rows: level.rows(),
            dead: level.dead(),
            built: level.is_built(),
            busy: self.running.iter().any(|running| running.has(level)),
        };
        self.head.levels.iter().map(shape).collect()
    }

    fn begin(&mut self, due: &[usize]) -> Merge {
        let sources: Vec<Arc<Level>> = due.iter().map(|&at| self.head.levels[at].clone()).collect();
        self.next_token += 1;
        self.running.push(Running {
            token: self.next_token,
            revision: self.head.revision,
            sources: sources.clone(),
            buried: Vec::new(),
        });
        Merge {
            token: self.next_token,
            space: Arc::clone(&self.head.space),
            leaf_rows: self.options.leaf_rows,
            revision: self.head.revision,
            sources,
        }
    }

    /// Swaps a merged level in for its sources, in time proportional to what was removed from them meanwhile.
    /// `merged` must stem from a merge that this forest began.
    pub fn finish_merge(&mut self, merged: Merged) {
        let Some(at) = self
            .running
            .iter()
            .position(|running| running.token == merged.token)
        else {
            return;
        };
        let running = self.running.swap_remove(at);
        if running.revision == self.head.revision {
            self.quiet_at = Some(running.revision);
        }
        Arc::make_mut(&mut self.head.levels).retain(|level| !running.has(level));
        if let Some(level) = merged.level {
            for (id, revision) in running.buried {
                if let Some(slot) = level.find(id, u64::MAX - 1) {
                    level.bury(slot, revision);
                }
            }
            self.add_level(level);
        }
    }

    /// Runs every merge that is due, here and now.
    pub fn settle(&mut self) {
        while let Some(due) = self.due(&self.shapes()) {
            let merge = self.begin(&due);
            self.finish_merge(merge.run());
        }
    }
}

/// The buffer, made the forest's own if a snapshot holds it, with room for `rows` rows.
fn writable(buffer: &mut Arc<Buffer>, rows: usize) -> &mut Buffer {
    if Arc::get_mut(buffer).is_none() {
        *buffer = Arc::new(buffer.copy_with_room(rows));
    }
    Arc::get_mut(buffer).expect("no one else holds it")
}
