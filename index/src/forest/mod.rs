//! The dynamic structure: a forest of static trees, by the logarithmic method.
//!
//! The smallest *level* is a tree that grows by single points ([`growing`]). Once it is full, another one grows, and
//! levels are merged into packed ones of doubling size, and into a few when writes pause ([`policy`]), which
//! drops their dead. Removing a point marks it with a *tombstone*; replacing one removes it and stores it anew.
//!
//! One owner writes; any number of [`Snapshot`]s read, each at its own revision, and neither waits for the other:
//! levels are immutable and shared by count, tombstones are judged by revision, and of the level that grows what changes
//! is copied if a snapshot holds it. Merges run wherever the owner likes: [`Forest::begin_merge`] says what is due,
//! [`Merge::run`] does the work, [`Forest::finish_merge`] swaps the result in, while mutations and searches go on. No
//! call of the forest but [`Forest::settle`] does more than its own share of work.

mod growing;
mod level;
mod merge;
mod packed;
mod past;
mod policy;
mod snapshot;
mod tombstones;
mod validate;

use std::sync::Arc;

use crate::{Answer, ApplyError, KdTree, Point, Points, Search, SearchError, Space, kernel::Scale};
use growing::Growing;
use level::Level;
use merge::Running;
pub use merge::{Merge, Merged};
use packed::Packed;
use past::Past;
pub use snapshot::Snapshot;
use tombstones::HEAD;
pub use validate::ForestReport;

/// The sizes a forest is built with; [`ForestOptions::for_space`] has those that measure best.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ForestOptions {
    /// The greatest number of points in the level that grows by single points, from 1 to
    /// [`ForestOptions::MAX_GROWING_ROWS`]; a number outside that range counts as its nearer end.
    pub growing_rows: usize,
    /// The greatest number of points in a leaf, at least 1.
    pub leaf_rows: usize,
}

impl ForestOptions {
    /// The largest `growing_rows`: tombstones have room for that many points of a level that grows.
    pub const MAX_GROWING_ROWS: usize = 1 << 20;

    /// Leaves of 16 points, and a growing level of 65,536 points in a space of up to three dimensions or 8,192 in any
    /// other, where a search gains more from the full leaves of packed levels than it loses to their number.
    pub fn for_space(space: &Space) -> Self {
        Self {
            growing_rows: if space.dimension() > 3 {
                1 << 13
            } else {
                1 << 16
            },
            leaf_rows: 16,
        }
    }
}

/// A mutation of more rows than this part of what grows makes a level of its own, to be packed at once.
const LARGE: usize = 8;

/// A dynamic set of points of one space with exact nearest-neighbour search.
///
/// ```
/// use wayfold_index::{Forest, ForestOptions, Points, Search, Space};
///
/// let space = Space::se2();
/// let options = ForestOptions::for_space(&space);
/// let mut forest = Forest::new(space, options);
/// let mut points = Points::new(3);
/// points.push(1, 0, 1, &[0.0, 0.0, 0.0]);
/// points.push(2, 0, 1, &[1.0, 0.0, 0.0]);
/// forest.apply(1, &points, &[])?;
/// let before = forest.snapshot();
/// forest.apply(2, &Points::new(3), &[1])?;
/// assert_eq!(forest.search(&[0.0; 3], &Search::nearest_k(1))?.neighbors[0].id, 2);
/// assert_eq!(before.search(&[0.0; 3], &Search::nearest_k(1))?.neighbors[0].id, 1);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug)]
pub struct Forest {
    options: ForestOptions,
    /// The newest revision; a snapshot is a clone of it.
    head: Snapshot,
    /// What has grown further since snapshots were taken.
    past: Past<Growing>,
    running: Vec<Running>,
    next_token: u64,
    /// The revision at which whoever writes makes a pause: a whole merge has passed during it, or the owner says so.
    quiet_at: Option<u64>,
}

impl Forest {
    /// An empty forest at revision 0.
    pub fn new(space: Space, options: ForestOptions) -> Self {
        let options = ForestOptions {
            growing_rows: options
                .growing_rows
                .clamp(1, ForestOptions::MAX_GROWING_ROWS),
            leaf_rows: options.leaf_rows.max(1),
        };
        let growing = Growing::new(&space, options.leaf_rows, options.growing_rows);
        let head = Snapshot {
            scale: Scale::new(&space),
            space: Arc::new(space),
            revision: 0,
            live: 0,
            levels: Arc::default(),
            growing: Arc::new(growing),
        };
        Self {
            options,
            head,
            past: Past::default(),
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

    /// A copy of the point with this id.
    pub fn get(&self, id: u64) -> Option<Point> {
        self.head.get(id)
    }

    /// Answers `search` for a canonical `state` at the head.
    ///
    /// # Errors
    /// As [`Snapshot::search`].
    pub fn search(&self, state: &[f64], search: &Search<'_>) -> Result<Answer, SearchError> {
        self.head.search(state, search)
    }

    /// The head, frozen.
    pub fn snapshot(&self) -> Snapshot {
        self.head.clone()
    }

    /// An estimate of the bytes it holds, not counting what is held for snapshots alone.
    pub fn memory_bytes(&self) -> usize {
        self.head.memory_bytes()
    }

    /// Applies one mutation as `revision`: removes the points with the ids `removed`, then stores the canonical rows
    /// `stored`, in the place of points with the same ids. Returns how many of `removed` were there.
    ///
    /// # Errors
    /// `revision` is not above the forest's, the rows are not canonical states of the space, two have the same id, or
    /// there are more than [`KdTree::MAX_POINTS`]; nothing is changed then.
    pub fn apply(
        &mut self,
        revision: u64,
        stored: &Points,
        removed: &[u64],
    ) -> Result<usize, ApplyError> {
        let head = self.head.revision;
        if revision <= head {
            return Err(ApplyError::Revision { revision, head });
        }
        stored.check(&self.head.space)?;
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
        Ok(found)
    }

    /// Removes the point with this id as of `revision`; false if there is none.
    fn remove(&mut self, id: u64, revision: u64) -> bool {
        let head = &mut self.head;
        if let Some(slot) = head.growing.find(id, revision) {
            head.growing.bury(slot, revision);
            // Else what is written over and over would be searched through its past.
            let (rows, dead) = (head.growing.rows(), head.growing.dead());
            if dead >= policy::LEAST_ROWS && 2 * dead > rows {
                self.seal();
            }
        } else if let Some((at, slot)) = head.find_in_levels(id) {
            let level = &head.levels[at];
            level.bury(slot, revision);
            if let Some(running) = self.running.iter_mut().find(|running| running.has(level)) {
                running.buried.push((id, revision));
            }
        } else {
            return false;
        }
        self.head.live -= 1;
        true
    }

    /// Stores rows whose ids are not in the forest.
    fn store(&mut self, rows: &Points) {
        self.head.live += rows.len();
        if rows.len() > (self.options.growing_rows / LARGE).max(1) {
            let space = Arc::clone(&self.head.space);
            let packed = Packed::unbuilt(space, rows.clone());
            self.add_level(Level::Packed(Box::new(packed)));
            return;
        }
        for point in rows.iter() {
            let growing = self.past.make_mut(&mut self.head.growing);
            growing.push(point);
            if growing.is_full() {
                self.seal();
            }
        }
    }

    /// Makes a level of its own of what has grown, and lets another tree grow.
    fn seal(&mut self) {
        let empty = Arc::new(self.head.growing.renewed());
        let grown = std::mem::replace(&mut self.head.growing, empty);
        self.add_level(Level::Grown(grown));
    }

    fn add_level(&mut self, level: Level) {
        let levels = Arc::make_mut(&mut self.head.levels);
        let at = levels.partition_point(|held| held.rows() >= level.rows());
        levels.insert(at, Arc::new(level));
    }

    /// Says that whoever writes makes a pause: from now to the next mutation, merges work towards a single level. None
    /// is rebuilt for less than a sixteenth of it; what is less stays beside it.
    pub fn pause(&mut self) {
        self.quiet_at = Some(self.head.revision);
        self.past.clear();
    }

    /// The next merge that is due, or None. The forest works on as before until it is finished; further merges may
    /// begin meanwhile, of other levels. While no one writes, levels are merged until what is left beside the largest is less
    /// than a sixteenth of it.
    pub fn begin_merge(&mut self) -> Option<Merge> {
        let quiet = self.quiet_at == Some(self.head.revision);
        if quiet && self.head.growing.rows() >= policy::LEAST_ROWS {
            self.seal();
        }
        let shapes = self.shapes();
        let due = policy::next_merge(&shapes, KdTree::MAX_POINTS).or_else(|| {
            let next = || policy::next_while_quiet(&shapes, KdTree::MAX_POINTS);
            quiet.then(next).flatten()
        })?;
        Some(self.begin(&due))
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
                if let Some(slot) = level.find(id, HEAD) {
                    level.bury(slot, revision);
                }
            }
            self.add_level(level);
        }
    }

    /// Runs every merge that is due, here and now.
    pub fn settle(&mut self) {
        while let Some(due) = policy::next_merge(&self.shapes(), KdTree::MAX_POINTS) {
            let merge = self.begin(&due);
            self.finish_merge(merge.run());
        }
    }
}
