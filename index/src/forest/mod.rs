//! The dynamic structure: a forest of static trees, by the logarithmic method.
//!
//! One tree grows by single points ([`growing`]). Once it is full, it becomes a *level*, and another one grows; a large
//! mutation becomes a level at once. Both are *unpacked* until a merge. Merges pack levels into ones of doubling size,
//! and into a few when writes pause ([`policy`]); they drop dead points.
//! Removing a point marks it with a *tombstone*; replacing one removes it and stores the new one.
//!
//! One owner writes, and any number of [`ForestSnapshot`]s read, each at its own revision; neither waits for the other.
//! Levels are immutable and shared by count, a tombstone hides a point from its revision on, and the parts of the
//! growing tree that a snapshot holds are copied before they change. The owner chooses the thread of a merge:
//! [`Forest::begin_merge`] returns the next one, [`Merge::run`] does the work, and [`Forest::finish_merge`] swaps the
//! result in, while mutations and searches continue. No method of the forest except [`Forest::settle`] and
//! [`Forest::settle_up_to`] runs merges itself.

mod growing;
mod level;
mod merge;
mod policy;
mod retired;
mod snapshot;
mod static_level;
mod tombstones;
mod validate;

use std::{
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
    time::Instant,
};

use crate::{
    Answer, ApplyError, Point, Points, PointsError, Search, SearchError, Space, kernel::KeyMap,
};
use growing::GrowingTree;
use level::Level;
use merge::Running;
pub use merge::{Merge, Merged, ReplacedLevels};
use retired::Retired;
pub use snapshot::ForestSnapshot;
use static_level::StaticLevel;
use tombstones::LATEST;
pub use validate::ForestReport;

/// The sizes a forest is built with; [`ForestOptions::for_space`] has those that measure best.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ForestOptions {
    /// The greatest number of points in the tree that grows by single points, from 1 to
    /// [`ForestOptions::MAX_GROWING_ROWS`]; a number outside that range counts as its nearer end.
    pub growing_rows: usize,
    /// The greatest number of points in a leaf; 0 counts as 1.
    pub leaf_rows: usize,
}

impl ForestOptions {
    /// The largest `growing_rows`: tombstones have room for that many points of a growing tree.
    pub const MAX_GROWING_ROWS: usize = 1 << 20;

    /// Leaves of 16 points, and a growing tree of 65,536 points in a space of up to three dimensions or 8,192 in any
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

/// A mutation of more rows than `growing_rows` divided by this makes a level of its own, which a merge packs at once.
const LARGE_MUTATION_DIVISOR: usize = 8;

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
    head: ForestSnapshot,
    /// The growing trees that snapshots share.
    retired: Retired<GrowingTree>,
    running: Vec<Running>,
    /// The revision at which writes pause: a whole merge ran at it, or the owner called [`Forest::pause`].
    paused_at: Option<u64>,
}

impl Forest {
    /// An empty forest at revision 0.
    pub fn new(space: impl Into<Arc<Space>>, options: ForestOptions) -> Self {
        let space = space.into();
        let options = ForestOptions {
            growing_rows: options
                .growing_rows
                .clamp(1, ForestOptions::MAX_GROWING_ROWS),
            leaf_rows: options.leaf_rows.max(1),
        };
        let growing = GrowingTree::new(&space, options.leaf_rows, options.growing_rows);
        let head = ForestSnapshot {
            key_map: KeyMap::new(&space),
            space,
            revision: 0,
            live: 0,
            levels: Arc::default(),
            growing: Arc::new(growing),
        };
        Self {
            options,
            head,
            retired: Retired::default(),
            running: Vec::new(),
            paused_at: None,
        }
    }

    /// The space of the states.
    pub fn space(&self) -> &Space {
        &self.head.space
    }

    /// The number of points.
    pub fn len(&self) -> usize {
        self.head.live
    }

    /// True if the forest has no points.
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

    /// True if a point has this id.
    pub fn contains(&self, id: u64) -> bool {
        self.head.contains(id)
    }

    /// Answers `search` for a canonical `state` at the head.
    ///
    /// # Errors
    /// The errors of [`ForestSnapshot::search`].
    pub fn search(&self, state: &[f64], search: &Search<'_>) -> Result<Answer, SearchError> {
        self.head.search(state, search)
    }

    /// The head, frozen.
    pub fn snapshot(&self) -> ForestSnapshot {
        self.head.clone()
    }

    /// An estimate of the bytes that the forest holds, apart from those that only snapshots need.
    pub fn memory_bytes(&self) -> usize {
        self.head.memory_bytes()
    }

    /// Applies one mutation as `revision`: removes the points with the ids `removed`, then stores `stored`, replacing
    /// points with the same ids. Returns the number of points removed for `removed`.
    ///
    /// # Errors
    /// `revision` is not above the forest's or is `u64::MAX`, the rows are not canonical states of the space, two have the
    /// same id, or there are more than [`Points::MAX_POINTS`]; nothing is changed then.
    pub fn apply(
        &mut self,
        revision: u64,
        stored: &Points,
        removed: &[u64],
    ) -> Result<usize, ApplyError> {
        let head = self.head.revision;
        if revision <= head || revision > LATEST {
            return Err(ApplyError::Revision { revision, head });
        }
        stored.check(&self.head.space)?;
        Ok(self.apply_checked(revision, stored, removed))
    }

    /// Adds points to the newest revision: a forest that is built from stored points gets them in parts. No id may be
    /// in the forest.
    ///
    /// # Errors
    /// The rows are not canonical states of the space, two have the same id, one has an id of the forest, or there are
    /// more than [`Points::MAX_POINTS`]; nothing is changed then.
    pub fn load(&mut self, points: &Points) -> Result<(), ApplyError> {
        points.check(&self.head.space)?;
        let mut ids = points.ids().iter();
        if let Some(&id) = ids.find(|&&id| self.contains(id)) {
            return Err(PointsError::DuplicateId(id).into());
        }
        self.store(points);
        Ok(())
    }

    /// Acts like [`Forest::apply`] for a higher revision and points that were checked.
    pub(crate) fn apply_checked(
        &mut self,
        revision: u64,
        stored: &Points,
        removed: &[u64],
    ) -> usize {
        debug_assert!(revision > self.head.revision);
        debug_assert_eq!(stored.check(&self.head.space), Ok(()));
        // Set first, so that look-ups of this mutation do not find the points that it has removed.
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
        if let Some(slot) = head.growing.find(id, revision) {
            head.growing.mark_dead(slot, revision);
            // Without this, points that are written over and over would leave a tree of dead ones.
            let (rows, dead) = (head.growing.rows(), head.growing.dead());
            if dead >= policy::MIN_ROWS && 2 * dead > rows {
                self.seal();
            }
        } else if let Some((at, slot)) = head.find_in_levels(id) {
            let level = &head.levels[at];
            level.mark_dead(slot, revision);
            if let Some(running) = self.running.iter_mut().find(|running| running.has(level)) {
                running.died.push((id, revision));
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
        if rows.len() > (self.options.growing_rows / LARGE_MUTATION_DIVISOR).max(1) {
            let space = Arc::clone(&self.head.space);
            let level = StaticLevel::unpacked(space, rows);
            self.add_level(Level::Static(Box::new(level), Instant::now()));
            return;
        }
        for point in rows.iter() {
            let growing = self.retired.make_mut(&mut self.head.growing);
            growing.push(point);
            if growing.is_full() {
                self.seal();
            }
        }
    }

    /// Turns the growing tree into a level, and starts another one.
    fn seal(&mut self) {
        let empty = Arc::new(self.head.growing.renewed());
        let grown = std::mem::replace(&mut self.head.growing, empty);
        self.add_level(Level::Grown(grown, Instant::now()));
    }

    fn add_level(&mut self, level: Level) {
        let levels = Arc::make_mut(&mut self.head.levels);
        let at = levels.partition_point(|held| held.rows() >= level.rows());
        levels.insert(at, Arc::new(level));
    }

    /// Tells the forest that writes pause: until the next mutation, merges work towards a single level. No level is
    /// rebuilt for less than a sixteenth of its points; smaller levels stay separate.
    pub fn pause(&mut self) {
        self.paused_at = Some(self.head.revision);
        self.retired.clear();
    }

    /// The next merge that is due, or None. The forest stays usable until the merge is finished, and merges of other
    /// levels may begin meanwhile. While writes pause, levels are merged until the levels other than the largest are
    /// together less than a sixteenth of it.
    pub fn begin_merge(&mut self) -> Option<Merge> {
        self.begin_merge_up_to(Points::MAX_POINTS)
    }

    /// Like [`Forest::begin_merge`], for merges that make levels of at most `max_rows` points: a merge needs memory for
    /// the new level while the old ones still exist.
    pub fn begin_merge_up_to(&mut self, max_rows: usize) -> Option<Merge> {
        let max_rows = max_rows.min(Points::MAX_POINTS);
        let paused = self.paused_at == Some(self.head.revision);
        if paused && self.head.growing.rows() >= policy::MIN_ROWS {
            self.seal();
        }
        let shapes = self.shapes();
        let due = policy::next_merge(&shapes, max_rows).or_else(|| {
            let next = || policy::next_while_paused(&shapes, max_rows);
            paused.then(next).flatten()
        })?;
        Some(self.begin(&due))
    }

    fn shapes(&self) -> Vec<policy::Shape> {
        let shape = |level: &Arc<Level>| policy::Shape {
            rows: level.rows(),
            dead: level.dead(),
            packed: level.is_packed(),
            busy: self.running.iter().any(|running| running.has(level)),
        };
        self.head.levels.iter().map(shape).collect()
    }

    fn begin(&mut self, due: &[usize]) -> Merge {
        let sources: Vec<Arc<Level>> = due.iter().map(|&at| self.head.levels[at].clone()).collect();
        // The counter is global: no forest takes the merge of another one for its own.
        static MERGES: AtomicU64 = AtomicU64::new(0);
        let token = MERGES.fetch_add(1, Ordering::Relaxed);
        self.running.push(Running {
            token,
            revision: self.head.revision,
            sources: sources.clone(),
            died: Vec::new(),
        });
        Merge {
            token,
            space: Arc::clone(&self.head.space),
            leaf_rows: self.options.leaf_rows,
            revision: self.head.revision,
            sources,
        }
    }

    /// Replaces the sources of a merge by the merged level, in time proportional to the points removed from them
    /// meanwhile. A merge that another forest began is ignored.
    ///
    /// Freeing the levels can take milliseconds: drop the result after the forest's lock.
    pub fn finish_merge(&mut self, merged: Merged) -> ReplacedLevels {
        let Some(at) = self
            .running
            .iter()
            .position(|running| running.token == merged.token)
        else {
            return ReplacedLevels {
                _levels: merged.level.into_iter().map(Arc::new).collect(),
            };
        };
        let running = self.running.swap_remove(at);
        if running.revision == self.head.revision {
            self.paused_at = Some(running.revision);
        }
        Arc::make_mut(&mut self.head.levels).retain(|level| !running.has(level));
        if let Some(level) = merged.level {
            for &(id, revision) in &running.died {
                if let Some(slot) = level.find(id, LATEST) {
                    level.mark_dead(slot, revision);
                }
            }
            self.add_level(level);
        }
        ReplacedLevels {
            _levels: running.sources,
        }
    }

    /// Runs every merge that is due, on this thread.
    pub fn settle(&mut self) {
        self.settle_up_to(|| Points::MAX_POINTS);
    }

    /// Like [`Forest::settle`], for merges that make levels of at most `max_rows` points.
    pub fn settle_up_to(&mut self, max_rows: impl Fn() -> usize) {
        let most = || max_rows().min(Points::MAX_POINTS);
        while let Some(due) = policy::next_merge(&self.shapes(), most()) {
            let merge = self.begin(&due);
            self.finish_merge(merge.run());
        }
    }
}
