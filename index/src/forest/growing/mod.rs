//! The tree that grows by single points: a kd-tree that splits as Robinson's does ("The K-D-B-Tree: A Search Structure
//! for Large Multidimensional Dynamic Indexes", SIGMOD 1981).
//!
//! A point goes to the leaf whose region contains it, and the boxes above are widened to contain it. A full leaf is
//! split at a median, and a full node along its own first cut, so that regions never overlap and no split reaches
//! downwards. All leaves are equally deep. Points in sorted order make such a tree higher than it should be, and points
//! that coincide make a leaf larger. Then, or once it has its greatest number of points, the tree is *full*: a merge
//! packs it into a static tree (see [`KdTree`](crate::KdTree)), and another one grows.
//!
//! Copies share everything that has not changed since. A point that is added under a snapshot costs a copy of the nodes
//! on its way, of its leaf, and of up to 64 rows of the log; every 64th one, of the table of the log's chunks too.
//!
//! A row is stored twice: in its leaf, and in the log, which finds it by its slot and is scanned in memory order. One
//! copy saves memory and slows searches. With rows in the log alone a leaf gathers them; with rows in the leaves alone
//! a scan reads leaves that are two thirds full. All spaces have two copies, so that there is one layout. Ratios to two
//! copies (8,000 points; Intel Xeon with AVX-512, 23 November 2026, recorded at ef5d762):
//!
//! | rows in | space | insert | random tree | k = 1 | k = 10 | radius | bytes |
//! |---|---|---|---|---|---|---|---|
//! | the log | R3 | | 1.41 | 1.61 | 1.61 | 1.52 | |
//! | | SE3 | | 1.88 | 2.07 | 1.98 | 1.95 | |
//! | | SE3² | | 2.58 | 2.60 | 1.78 | 1.20 | |
//! | | SE3⁴ | | 0.99 | 1.05 | 1.02 | 1.02 | |
//! | the leaves | R3 | 1.04 | 1.01 | 1.01 | 1.01 | 1.01 | 0.83 |
//! | | SE3 | 1.04 | 1.00 | 1.00 | 1.00 | 1.00 | 0.75 |
//! | | SE3² | 0.99 | 1.02 | 1.01 | 1.20 | 1.28 | 0.70 |
//! | | SE3⁴ | 0.95 | 1.48 | 1.58 | 1.43 | 1.44 | 0.67 |

mod branch;
mod ids;
mod insertion_log;
mod leaf;
mod validate;

use std::sync::Arc;

use super::{level::PointsById, tombstones::Tombstones};
use crate::{
    Point, PointRef, Points, Space,
    lanes::Isa,
    scan_policy::ScanPolicy,
    traversal::{Frontier, Labels, MAX_HEIGHT, Traversal, Tree},
};
use branch::{Branch, Cell, Insertion};
use ids::Ids;
use insertion_log::InsertionLog;
use leaf::{Label, Leaf, LeafBlock};

/// A tree, its points in the order of insertion, the slots of their ids, and the tombstones of the dead ones.
#[derive(Clone, Debug)]
pub(super) struct GrowingTree {
    /// The length of a unit of each coordinate in the metric.
    unit_lengths: Arc<[f64]>,
    leaf_rows: usize,
    root: Cell,
    /// The number of nodes between the root, included, and a leaf.
    height: usize,
    /// True if points that coincide have filled a leaf.
    overflowed: bool,
    /// The newest revision of a state.
    newest: u64,
    log: InsertionLog,
    ids: Ids,
    tombstones: Arc<Tombstones>,
    max_rows: usize,
    scan_policy: Arc<ScanPolicy>,
}

impl GrowingTree {
    /// An empty tree for at most `max_rows` points.
    pub(super) fn new(space: &Space, leaf_rows: usize, max_rows: usize) -> Self {
        Self::empty(space.unit_lengths().into(), leaf_rows, max_rows)
    }

    /// Another empty tree of the same sizes.
    pub(super) fn renewed(&self) -> Self {
        Self::empty(
            Arc::clone(&self.unit_lengths),
            self.leaf_rows,
            self.max_rows,
        )
    }

    fn empty(unit_lengths: Arc<[f64]>, leaf_rows: usize, max_rows: usize) -> Self {
        let width = unit_lengths.len();
        Self {
            unit_lengths,
            leaf_rows,
            root: Cell::Leaf(Leaf::new(width)),
            height: 0,
            overflowed: false,
            newest: 0,
            log: InsertionLog::new(width),
            ids: Ids::default(),
            tombstones: Arc::default(),
            max_rows,
            scan_policy: Arc::default(),
        }
    }

    /// The number of points stored, dead ones included.
    pub(super) fn rows(&self) -> usize {
        self.log.rows()
    }

    /// The number of points dead at the head.
    pub(super) fn dead(&self) -> usize {
        self.tombstones.dead()
    }

    /// True if the tree should take no more points.
    pub(super) fn is_full(&self) -> bool {
        let rows = self.rows();
        // The height with half of the places in leaves and six of sixteen children used, and three more.
        let expected = 3 + (2 * rows / self.leaf_rows).max(1).ilog(6) as usize;
        rows >= self.max_rows || self.overflowed || self.height > expected.min(MAX_HEIGHT - 1)
    }

    /// Adds a point whose id is not alive in the tree.
    pub(super) fn push(&mut self, point: PointRef<'_>) {
        let slot = self.rows();
        self.log.push(point);
        self.ids.push(point.id, slot);
        let label = Label {
            id: point.id,
            slot: slot as u32,
        };
        let mut insertion = Insertion {
            label,
            revision: point.revision,
            row: point.row,
            unit_lengths: &self.unit_lengths,
            leaf_rows: self.leaf_rows,
            tombstones: &self.tombstones,
            overflows: false,
        };
        self.newest = self.newest.max(point.revision);
        let split = self.root.insert(&mut insertion);
        self.overflowed |= insertion.overflows;
        if let Some(split) = split {
            let width = self.unit_lengths.len();
            let below = std::mem::replace(&mut self.root, Cell::Leaf(Leaf::new(width)));
            let branch = Branch::over(below, split, self.newest, width);
            self.root = Cell::Branch(Arc::new(branch));
            self.height += 1;
        }
    }

    /// A copy of the point in `slot`.
    pub(super) fn get(&self, slot: usize) -> Point {
        self.log.get(slot)
    }

    /// Appends a copy of the point in `slot` to `points`.
    pub(super) fn copy_to(&self, slot: usize, points: &mut Points) {
        self.log.copy_to(slot, points);
    }

    pub(super) fn is_visible(&self, slot: usize, revision: u64) -> bool {
        self.tombstones.is_visible(slot, revision)
    }

    /// The slot of the point with this id, if a reader at `revision` sees it.
    pub(super) fn find(&self, id: u64, revision: u64) -> Option<usize> {
        let slot = self.ids.find(id, &self.log)?;
        self.is_visible(slot, revision).then_some(slot)
    }

    /// The points that a reader at `revision` sees above the id `after`.
    pub(super) fn points_after(&self, after: Option<u64>, revision: u64) -> PointsById<'_> {
        let slots = self.ids.after(after, &self.log);
        let visible = slots.filter(move |&slot| self.is_visible(slot, revision));
        Box::new(visible.map(|slot| self.get(slot)))
    }

    /// Removes the point in `slot` as of `revision`.
    pub(super) fn mark_dead(&self, slot: usize, revision: u64) {
        self.tombstones.mark_dead(slot, self.max_rows, revision);
    }

    /// Searches the points that a reader at `revision` sees.
    #[inline(always)]
    pub(super) fn search<'a, I: Isa>(&'a self, traversal: &mut Traversal<'a>, revision: u64) {
        let tree = self;
        if self.rows() == 0 {
            return;
        }
        if self.tombstones.dead() == 0 {
            // A tombstone at or before the reader's revision was published with it, and would be seen here.
            let is_visible = |_: usize| true;
            traversal.search::<I, _>(&mut GrowingSearch { tree, is_visible });
        } else {
            let is_visible = |slot: usize| self.is_visible(slot, revision);
            traversal.search::<I, _>(&mut GrowingSearch { tree, is_visible });
        }
    }

    pub(super) fn memory_bytes(&self) -> usize {
        self.root.memory_bytes()
            + self.log.memory_bytes()
            + self.ids.memory_bytes()
            + self.tombstones.memory_bytes()
    }
}

/// One search of a growing tree, which finds the visible points.
struct GrowingSearch<'a, V> {
    tree: &'a GrowingTree,
    is_visible: V,
}

impl<'a, V: Fn(usize) -> bool> Tree<'a> for GrowingSearch<'a, V> {
    type Cell = &'a Cell;
    type Children = &'a Branch;

    fn newest(&self) -> u64 {
        self.tree.newest
    }

    #[inline(always)]
    fn root(&self) -> Option<&'a Cell> {
        Some(&self.tree.root)
    }

    #[inline(always)]
    fn child(&self, branch: &'a Branch, child: usize) -> &'a Cell {
        &branch.children[child]
    }

    #[inline(always)]
    fn visit<I: Isa>(
        &mut self,
        cell: &'a Cell,
        traversal: &mut Traversal<'a>,
        frontier: &mut Frontier<&'a Branch>,
    ) {
        match cell {
            Cell::Branch(branch) => {
                let since = traversal.since_revision();
                let lanes = if since > 0 {
                    branch.newer_than(since)
                } else {
                    !(!0 << branch.children.len())
                };
                let branch: &'a Branch = branch;
                traversal.expand::<I, _>(frontier, branch.boxes.node(0), lanes, branch);
            }
            Cell::Leaf(leaf) => {
                let blocks = traversal.enter_leaf().then(|| leaf.blocks());
                for block in blocks.into_iter().flatten() {
                    let log = &self.tree.log;
                    let labels = LeafLabels { block, log };
                    let is_visible = |lane| (self.is_visible)(labels.slot(lane));
                    let (columns, lanes) = (block.columns, block.lanes);
                    traversal.scan_block::<I>(columns, lanes, &labels, |lane| lane, is_visible);
                }
            }
        }
    }

    #[inline(always)]
    fn scan<I: Isa>(&mut self, traversal: &mut Traversal<'a>) {
        self.tree.log.scan::<I>(traversal, &self.is_visible);
    }

    #[inline(always)]
    fn scan_policy(&self) -> Option<&'a ScanPolicy> {
        (self.tree.height > 1).then_some(&*self.tree.scan_policy)
    }

    fn scan_is_cheaper(&self, leaves: usize) -> bool {
        // Leaves are two thirds full.
        2 * leaves >= 3 * self.tree.rows() / self.tree.leaf_rows.saturating_mul(2)
    }
}

/// The labels of the points in a block of a leaf, by lane.
struct LeafLabels<'a> {
    block: LeafBlock<'a>,
    log: &'a InsertionLog,
}

impl LeafLabels<'_> {
    fn slot(&self, lane: usize) -> usize {
        self.block.label(lane).slot as usize
    }
}

impl Labels for LeafLabels<'_> {
    fn id(&self, lane: usize) -> u64 {
        self.block.label(lane).id
    }

    fn tag(&self, lane: usize) -> u64 {
        self.log.tag(self.slot(lane))
    }

    fn revision(&self, lane: usize) -> u64 {
        self.log.revision(self.slot(lane))
    }
}
