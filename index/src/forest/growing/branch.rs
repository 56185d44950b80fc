//! The inner nodes of a growing tree.

use std::sync::Arc;

use arrayvec::ArrayVec;

use super::leaf::{Label, Leaf};
use crate::{
    boxes::Boxes,
    forest::{policy::MIN_ROWS, tombstones::Tombstones},
    lanes::MAX_CHILDREN,
};

/// A subtree: the points in the region that the cuts above it leave.
#[derive(Clone, Debug)]
pub(super) enum Cell {
    Branch(Arc<Branch>),
    Leaf(Leaf),
}

/// A plane through a region, with the side below it and the side above it, which includes the points on the plane.
#[derive(Clone, Copy, Debug)]
struct Cut {
    axis: u32,
    at: f64,
    sides: [Side; 2],
}

/// One side of a cut: another cut, or the region of a child.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Side {
    Cut(u8),
    Child(u8),
}

/// A node of up to sixteen children. A small kd-tree of cuts routes a new point to one of them, and searches read their
/// boxes. A node that a snapshot shares is copied before it changes.
#[derive(Clone, Debug)]
pub(super) struct Branch {
    /// The boxes of one node, this one.
    pub(super) boxes: Boxes,
    /// The newest revision of a state below each child.
    pub(super) newest: [u64; MAX_CHILDREN],
    pub(super) children: ArrayVec<Cell, MAX_CHILDREN>,
    /// The first one cuts the region of the node. There is one cut less than there are children.
    cuts: ArrayVec<Cut, { MAX_CHILDREN - 1 }>,
}

/// A new point, on its way to its leaf.
pub(super) struct Insertion<'a> {
    pub(super) label: Label,
    pub(super) revision: u64,
    pub(super) row: &'a [f64],
    /// The length of a unit of each coordinate in the metric.
    pub(super) unit_lengths: &'a [f64],
    /// The number of points above which a leaf is split, if it can be.
    pub(super) leaf_rows: usize,
    /// The tombstones of the tree.
    pub(super) tombstones: &'a Tombstones,
    /// Set if a leaf that cannot be split is larger than the tree should hold.
    pub(super) overflows: bool,
}

/// The size of a leaf of points that coincide, in full leaves, above which the tree grows no further; [`MIN_ROWS`]
/// points if that is more.
const MAX_COINCIDING_LEAVES: usize = 8;

/// The split of a full cell: the cell keeps the points below a plane, and `above` has the others.
pub(super) struct Split {
    axis: usize,
    at: f64,
    above: Cell,
}

impl Cell {
    /// Adds a point to the leaf whose region contains it, and splits the cell if it becomes too full.
    pub(super) fn insert(&mut self, point: &mut Insertion<'_>) -> Option<Split> {
        match self {
            Cell::Branch(branch) => Arc::make_mut(branch).insert(point),
            Cell::Leaf(leaf) => {
                leaf.push(point.label, point.row.iter().copied());
                if leaf.rows() <= point.leaf_rows {
                    return None;
                }
                // Without this, points that move in one place would leave many dead ones there.
                leaf.drop_dead(point.tombstones);
                if leaf.rows() <= point.leaf_rows {
                    return None;
                }
                let Some((axis, at)) = median_cut(leaf, point.unit_lengths) else {
                    let max_rows = point.leaf_rows.saturating_mul(MAX_COINCIDING_LEAVES);
                    point.overflows |= leaf.rows() > max_rows.max(MIN_ROWS);
                    return None;
                };
                let [below, above] = leaf.split(axis, at);
                *leaf = below;
                let above = Cell::Leaf(above);
                Some(Split { axis, at, above })
            }
        }
    }

    pub(super) fn memory_bytes(&self) -> usize {
        match self {
            Cell::Leaf(leaf) => leaf.memory_bytes(),
            Cell::Branch(branch) => {
                let below = branch.children.iter().map(Self::memory_bytes);
                size_of::<Branch>() + branch.boxes.memory_bytes() + below.sum::<usize>()
            }
        }
    }

    /// The ends, in each coordinate, of the smallest box around its points.
    fn bounds(&self, width: usize) -> impl Iterator<Item = (f64, f64)> {
        (0..width).map(move |axis| match self {
            Cell::Leaf(leaf) => leaf.extent(axis),
            Cell::Branch(branch) => {
                let count = branch.children.len();
                branch.boxes.around_children(0, count, axis)
            }
        })
    }
}

/// The cut of a leaf across the coordinate in which its points spread most in the metric: at the median, or at the next
/// number that leaves points on both sides. None if all points coincide.
fn median_cut(leaf: &Leaf, unit_lengths: &[f64]) -> Option<(usize, f64)> {
    let width = unit_lengths.len();
    let spread = |axis: usize| {
        let (lo, hi) = leaf.extent(axis);
        (lo < hi).then_some((axis, unit_lengths[axis] * (hi - lo), lo))
    };
    let (axis, _, lo) = (0..width)
        .filter_map(spread)
        .max_by(|a, b| a.1.total_cmp(&b.1))?;
    let mut numbers: Vec<f64> = leaf.columns(axis).flatten().copied().collect();
    numbers.sort_unstable_by(f64::total_cmp);
    let upper = &numbers[numbers.len() / 2..];
    Some((axis, *upper.iter().find(|&&x| x > lo)?))
}

impl Branch {
    fn empty(width: usize) -> Self {
        Self {
            boxes: Boxes::new(width, 1),
            newest: [0; MAX_CHILDREN],
            children: ArrayVec::new(),
            cuts: ArrayVec::new(),
        }
    }

    /// A new root over the two parts of the old one.
    pub(super) fn over(below: Cell, split: Split, newest: u64, width: usize) -> Self {
        let mut branch = Self::empty(width);
        branch.newest[0] = newest;
        branch.children.push(below);
        branch.add(0, split, width);
        branch
    }

    /// A bit for each child that has a state newer than a revision.
    pub(super) fn newer_than(&self, revision: u64) -> u32 {
        let count = self.children.len();
        let newer = |&(_, &newest): &(usize, &u64)| newest > revision;
        let children = self.newest[..count].iter().enumerate().filter(newer);
        children.fold(0, |bits, (child, _)| bits | 1 << child)
    }

    fn insert(&mut self, point: &mut Insertion<'_>) -> Option<Split> {
        let child = self.route(point.row);
        let split = self.children[child].insert(point);
        self.boxes.widen(0, child, point.row);
        self.newest[child] = self.newest[child].max(point.revision);
        let split = split?;
        let width = point.row.len();
        if !self.children.is_full() {
            self.add(child, split, width);
            return None;
        }
        // The node splits along its first cut, so that regions stay disjoint. A split by the children's boxes would let
        // them overlap.
        let Cut { axis, at, sides } = self.cuts[0];
        let [mut below, mut above] = sides.map(|side| self.part(side, width));
        let axis = axis as usize;
        // The row still leads to the child that was split.
        let part = if point.row[axis] >= at {
            &mut above
        } else {
            &mut below
        };
        part.add(part.route(point.row), split, width);
        *self = below;
        let above = Cell::Branch(Arc::new(above));
        Some(Split { axis, at, above })
    }

    /// The child whose region contains a row.
    pub(super) fn route(&self, row: &[f64]) -> usize {
        let mut side = self.root();
        loop {
            match side {
                Side::Child(child) => return child.into(),
                Side::Cut(cut) => {
                    let cut = &self.cuts[usize::from(cut)];
                    side = cut.sides[usize::from(row[cut.axis as usize] >= cut.at)];
                }
            }
        }
    }

    fn root(&self) -> Side {
        if self.cuts.is_empty() {
            Side::Child(0)
        } else {
            Side::Cut(0)
        }
    }

    /// Adds the part that a child has lost by a split as another child.
    fn add(&mut self, child: usize, split: Split, width: usize) {
        let Split { axis, at, above } = split;
        let (held, added) = (Side::Child(child as u8), self.children.len());
        let cut = Side::Cut(self.cuts.len() as u8);
        let mut sides = self.cuts.iter_mut().flat_map(|cut| &mut cut.sides);
        if let Some(side) = sides.find(|side| **side == held) {
            *side = cut;
        }
        let sides = [held, Side::Child(added as u8)];
        let axis = axis as u32;
        self.cuts.push(Cut { axis, at, sides });
        self.children.push(above);
        self.newest[added] = self.newest[child];
        for child in [child, added] {
            let ends = self.children[child].bounds(width);
            self.boxes.set(0, child, ends);
        }
    }

    /// A node of the children on one side of a cut.
    fn part(&self, side: Side, width: usize) -> Self {
        let mut part = Self::empty(width);
        part.take(self, side);
        part
    }

    /// Adds the children on one side of another node's cut; returns the side that they are here.
    fn take(&mut self, from: &Self, side: Side) -> Side {
        match side {
            Side::Child(child) => {
                let (child, place) = (usize::from(child), self.children.len());
                self.boxes.set(0, place, from.boxes.child(0, child));
                self.newest[place] = from.newest[child];
                self.children.push(from.children[child].clone());
                Side::Child(place as u8)
            }
            Side::Cut(cut) => {
                let at = self.cuts.len();
                let cut = from.cuts[usize::from(cut)];
                self.cuts.push(cut);
                let sides = cut.sides.map(|side| self.take(from, side));
                self.cuts[at].sides = sides;
                Side::Cut(at as u8)
            }
        }
    }
}
