//! The smallest level: a kd-tree that grows by single points, as Robinson's K-D-B-tree does ("The K-D-B-Tree: A Search
//! Structure for Large Multidimensional Dynamic Indexes", SIGMOD 1981).
//!
//! A point goes to the leaf in whose region it lies, and the boxes on its way are made to hold it. A full leaf is split
//! at a median; a full node along its own first cut, so that regions never overlap and no split reaches downwards. All
//! leaves are equally deep. Points that come in an order of their own make such a tree higher than it should be, and
//! points that coincide a leaf larger: then, or once it has as many points as it may, it is *full*, to be packed into a
//! static tree (see [`KdTree`](crate::KdTree)) by a merge, and another one grows.
//!
//! Copies share all that has not changed since: a point that is added under a snapshot costs a copy of the nodes on its
//! way, of its leaf, and of some dozens of rows.

mod arrivals;
mod branch;
mod leaf;
mod slots;
mod validate;

use std::sync::Arc;

use super::{level::InOrder, tombstones::Tombstones};
use crate::{
    Point, PointRef, Points, Space,
    kdtree::{Reach, scales},
    kernel::Set,
    search::{Ahead, MOST_HEIGHT, Table, Walk},
};
use arrivals::Arrivals;
use branch::{Arrival, Branch, Cell};
use leaf::{Label, Leaf, LeafBlock};
use slots::Slots;

/// A tree, the points in the order in which they came, the way from an id to its point, and the marks of what has died.
#[derive(Clone, Debug)]
pub(super) struct Growing {
    /// What a unit of each coordinate is worth in the metric.
    scales: Arc<[f64]>,
    leaf_rows: usize,
    root: Cell,
    /// Nodes on the way from the root to a leaf.
    height: usize,
    /// Whether points that coincide have filled a leaf.
    crowded: bool,
    /// The newest revision of a state.
    newest: u64,
    arrivals: Arrivals,
    slots: Slots,
    tombstones: Arc<Tombstones>,
    most_rows: usize,
    reach: Arc<Reach>,
}

impl Growing {
    /// An empty tree for at most `most_rows` points.
    pub(super) fn new(space: &Space, leaf_rows: usize, most_rows: usize) -> Self {
        Self::empty(scales(space).into(), leaf_rows, most_rows)
    }

    /// Another one, as this was.
    pub(super) fn renewed(&self) -> Self {
        Self::empty(Arc::clone(&self.scales), self.leaf_rows, self.most_rows)
    }

    fn empty(scales: Arc<[f64]>, leaf_rows: usize, most_rows: usize) -> Self {
        let width = scales.len();
        Self {
            scales,
            leaf_rows,
            root: Cell::Leaf(Leaf::new(width)),
            height: 0,
            crowded: false,
            newest: 0,
            arrivals: Arrivals::new(width),
            slots: Slots::default(),
            tombstones: Arc::default(),
            most_rows,
            reach: Arc::default(),
        }
    }

    /// How many points it stores, dead ones included.
    pub(super) fn rows(&self) -> usize {
        self.arrivals.rows()
    }

    /// How many of them are dead at the head.
    pub(super) fn dead(&self) -> usize {
        self.tombstones.dead()
    }

    /// Whether it should take no more points.
    pub(super) fn is_full(&self) -> bool {
        let rows = self.rows();
        // With half of its leaves' places and six of sixteen children used, and some more.
        let fair = 3 + (2 * rows / self.leaf_rows).max(1).ilog(6) as usize;
        rows >= self.most_rows || self.crowded || self.height > fair.min(MOST_HEIGHT - 1)
    }

    /// Adds a point whose id is not alive in it.
    pub(super) fn push(&mut self, point: PointRef<'_>) {
        let slot = self.rows();
        self.arrivals.push(point);
        self.slots.push(point.id, slot);
        let label = Label {
            id: point.id,
            slot: slot as u32,
        };
        let mut arrival = Arrival {
            label,
            revision: point.revision,
            row: point.row,
            scales: &self.scales,
            leaf_rows: self.leaf_rows,
            tombstones: &self.tombstones,
            crowds: false,
        };
        self.newest = self.newest.max(point.revision);
        let split = self.root.insert(&mut arrival);
        self.crowded |= arrival.crowds;
        if let Some(split) = split {
            let width = self.scales.len();
            let below = std::mem::replace(&mut self.root, Cell::Leaf(Leaf::new(width)));
            let branch = Branch::over(below, split, self.newest, width);
            self.root = Cell::Branch(Arc::new(branch));
            self.height += 1;
        }
    }

    pub(super) fn get(&self, slot: usize) -> Point {
        self.arrivals.get(slot).to_point()
    }

    /// Appends a copy of the point in `slot` to `points`.
    pub(super) fn copy_to(&self, slot: usize, points: &mut Points) {
        points.push_point(self.arrivals.get(slot));
    }

    pub(super) fn sees(&self, slot: usize, revision: u64) -> bool {
        self.tombstones.sees(slot, revision)
    }

    /// The slot of the point with this id, if a reader at `revision` sees it.
    pub(super) fn find(&self, id: u64, revision: u64) -> Option<usize> {
        let slot = self.slots.find(id, &self.arrivals)?;
        self.sees(slot, revision).then_some(slot)
    }

    /// What a reader at `revision` sees of the ids above `after`, in their order.
    pub(super) fn points_after(&self, after: Option<u64>, revision: u64) -> InOrder<'_> {
        let slots = self.slots.after(after, &self.arrivals);
        let seen = slots.filter(move |&slot| self.sees(slot, revision));
        Box::new(seen.map(|slot| self.get(slot)))
    }

    /// Removes the point in `slot` as of `revision`.
    pub(super) fn bury(&self, slot: usize, revision: u64) {
        self.tombstones.bury(slot, self.most_rows, revision);
    }

    /// Shows `walk` what a reader at `revision` sees.
    #[inline(always)]
    pub(super) fn visit<'a, S: Set>(&'a self, walk: &mut Walk<'a>, revision: u64) {
        if self.tombstones.dead() == 0 {
            // No mark at or before the reader's revision can be missed: those were published with it.
            self.visit_visible::<S>(walk, |_| true);
        } else {
            self.visit_visible::<S>(walk, |slot| self.sees(slot, revision));
        }
    }

    #[inline(always)]
    fn visit_visible<'a, S: Set>(&'a self, walk: &mut Walk<'a>, visible: impl Fn(usize) -> bool) {
        let since = walk.since_revision();
        if self.rows() == 0 || (since > 0 && self.newest <= since) {
            return;
        }
        let plain = walk.is_plain() && self.height > 1;
        if plain && self.reach.is_far() {
            self.arrivals.visit::<S>(walk, visible);
            return;
        }
        let entered = walk.leaves_entered();
        let (mut ahead, mut next) = (Ahead::new(), Some(&self.root));
        while let Some(cell) = next {
            match cell {
                Cell::Branch(branch) => {
                    let children = &branch.children;
                    let lanes = if since > 0 {
                        branch.newer_than(since)
                    } else {
                        !(!0 << children.len())
                    };
                    walk.open::<S, _>(&mut ahead, &branch.boxes, lanes, children);
                }
                Cell::Leaf(leaf) => {
                    let blocks = walk.enters_leaf().then(|| leaf.blocks());
                    for block in blocks.into_iter().flatten() {
                        let table = Labelled {
                            block,
                            arrivals: &self.arrivals,
                        };
                        let seen = |lane| visible(table.slot(lane));
                        let (columns, lanes) = (block.columns, block.lanes);
                        walk.scan::<S>(columns, lanes, &table, |lane| lane, seen);
                    }
                }
            }
            let child = walk.next::<S, _>(&mut ahead);
            next = child.map(|(children, child)| &children[child]);
        }
        if plain && walk.found_few() {
            let reached = walk.leaves_entered() - entered;
            // Leaves are two thirds full.
            let leaves = 3 * self.rows() / self.leaf_rows.saturating_mul(2);
            self.reach.report(2 * reached >= leaves);
        }
    }

    pub(super) fn memory_bytes(&self) -> usize {
        self.root.memory_bytes()
            + self.arrivals.memory_bytes()
            + self.slots.memory_bytes()
            + self.tombstones.memory_bytes()
    }
}

/// The points of a leaf's block, by their lanes.
struct Labelled<'a> {
    block: LeafBlock<'a>,
    arrivals: &'a Arrivals,
}

impl Labelled<'_> {
    fn slot(&self, lane: usize) -> usize {
        self.block.label(lane).slot as usize
    }
}

impl Table for Labelled<'_> {
    fn id(&self, lane: usize) -> u64 {
        self.block.label(lane).id
    }

    fn tag(&self, lane: usize) -> u64 {
        self.arrivals.tag(self.slot(lane))
    }

    fn revision(&self, lane: usize) -> u64 {
        self.arrivals.revision(self.slot(lane))
    }
}
