//! The inner nodes of a growing tree.

use std::sync::Arc;

use arrayvec::ArrayVec;

use super::leaf::{Label, Leaf};
use crate::{
    forest::{policy::LEAST_ROWS, tombstones::Tombstones},
    kernel::CHILDREN,
};

/// A cell of the tree: all that lies on one side of each of the cuts above it.
#[derive(Clone, Debug)]
pub(super) enum Cell {
    Branch(Arc<Branch>),
    Leaf(Leaf),
}

/// A plane through a region, and what lies below it and, with the points on it, above.
#[derive(Clone, Copy, Debug)]
struct Cut {
    axis: u32,
    at: f64,
    sides: [Side; 2],
}

/// One side of a cut: it is cut again, or it is a child's region.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Side {
    Cut(u8),
    Child(u8),
}

/// A node of up to sixteen children: a small kd-tree of cuts leads a new point to one of them, and their boxes lie side by
/// side for searches. What a snapshot shares is copied before it changes.
#[derive(Clone, Debug)]
pub(super) struct Branch {
    /// For each coordinate the lower ends of the children's boxes, then the upper ends.
    pub(super) boxes: Box<[f64]>,
    /// The newest revision of a state below each child.
    pub(super) newest: [u64; CHILDREN],
    pub(super) children: ArrayVec<Cell, CHILDREN>,
    /// The first cuts the region of the node; there is one cut less than there are children.
    cuts: ArrayVec<Cut, { CHILDREN - 1 }>,
}

/// A new point on its way to its leaf.
pub(super) struct Arrival<'a> {
    pub(super) label: Label,
    pub(super) revision: u64,
    pub(super) row: &'a [f64],
    /// What a unit of each coordinate is worth in the metric.
    pub(super) scales: &'a [f64],
    /// Most points of a leaf that can be split.
    pub(super) leaf_rows: usize,
    /// What of the tree has died.
    pub(super) tombstones: &'a Tombstones,
    /// Is set if so many more coincide that the tree should grow no further ([`CROWDED`]).
    pub(super) crowds: bool,
}

/// A leaf of points that coincide may be so many times as large as others, or have [`LEAST_ROWS`].
const CROWDED: usize = 8;

/// What became of a cell that was full: it keeps what lies below a plane, and this lies above.
pub(super) struct Split {
    axis: usize,
    at: f64,
    above: Cell,
}

impl Cell {
    /// Adds a point to the leaf that is there for it; splits what is full by that.
    pub(super) fn insert(&mut self, point: &mut Arrival<'_>) -> Option<Split> {
        match self {
            Cell::Branch(branch) => Arc::make_mut(branch).insert(point),
            Cell::Leaf(leaf) => {
                leaf.push(point.label, point.row.iter().copied());
                if leaf.rows() <= point.leaf_rows {
                    return None;
                }
                // Else points that move in one place would leave a long past there.
                leaf.forget(point.tombstones);
                if leaf.rows() <= point.leaf_rows {
                    return None;
                }
                let Some((axis, at)) = middle(leaf, point.scales) else {
                    let most = point.leaf_rows.saturating_mul(CROWDED).max(LEAST_ROWS);
                    point.crowds |= leaf.rows() > most;
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
                size_of::<Branch>() + size_of_val(&*branch.boxes) + below.sum::<usize>()
            }
        }
    }

    /// The ends of the box around its points in each coordinate.
    fn bounds(&self, width: usize) -> impl Iterator<Item = (f64, f64)> {
        (0..width).map(move |axis| match self {
            Cell::Leaf(leaf) => extent(leaf.column(axis)),
            Cell::Branch(branch) => {
                let ends = &branch.boxes[axis * 2 * CHILDREN..][..2 * CHILDREN];
                let count = branch.children.len();
                let (lo, _) = extent(ends[..count].iter().copied());
                let (_, hi) = extent(ends[CHILDREN..][..count].iter().copied());
                (lo, hi)
            }
        })
    }
}

/// The least and the greatest of some numbers.
fn extent(numbers: impl Iterator<Item = f64>) -> (f64, f64) {
    numbers.fold((f64::INFINITY, f64::NEG_INFINITY), |(lo, hi), x| {
        (lo.min(x), hi.max(x))
    })
}

/// The plane that parts the points of a leaf best: across the coordinate in which they spread most, as the metric weighs
/// it, at the median or else the next number that leaves points on both sides. None if all points coincide.
fn middle(leaf: &Leaf, scales: &[f64]) -> Option<(usize, f64)> {
    let width = scales.len();
    let spread = |axis: usize| {
        let (lo, hi) = extent(leaf.column(axis));
        (lo < hi).then_some((axis, scales[axis] * (hi - lo), lo))
    };
    let (axis, _, lo) = (0..width)
        .filter_map(spread)
        .max_by(|a, b| a.1.total_cmp(&b.1))?;
    let mut numbers: Vec<f64> = leaf.column(axis).collect();
    numbers.sort_unstable_by(f64::total_cmp);
    let upper = &numbers[numbers.len() / 2..];
    Some((axis, *upper.iter().find(|&&x| x > lo)?))
}

impl Branch {
    fn empty(width: usize) -> Self {
        Self {
            boxes: vec![0.0; 2 * CHILDREN * width].into(),
            newest: [0; CHILDREN],
            children: ArrayVec::new(),
            cuts: ArrayVec::new(),
        }
    }

    /// A node of the two parts of what was the root.
    pub(super) fn over(below: Cell, split: Split, newest: u64, width: usize) -> Self {
        let mut branch = Self::empty(width);
        branch.newest[0] = newest;
        branch.children.push(below);
        branch.add(0, split, width);
        branch
    }

    /// The bits of the children that have states newer than a revision.
    pub(super) fn newer_than(&self, revision: u64) -> u32 {
        let count = self.children.len();
        let newer = |&(_, &newest): &(usize, &u64)| newest > revision;
        let children = self.newest[..count].iter().enumerate().filter(newer);
        children.fold(0, |bits, (child, _)| bits | 1 << child)
    }

    fn insert(&mut self, point: &mut Arrival<'_>) -> Option<Split> {
        let child = self.route(point.row);
        let split = self.children[child].insert(point);
        self.widen(child, point.row);
        self.newest[child] = self.newest[child].max(point.revision);
        let split = split?;
        let width = point.row.len();
        if !self.children.is_full() {
            self.add(child, split, width);
            return None;
        }
        // Along the first plane, so that regions stay apart: to split by the children's boxes would let them overlap.
        let Cut { axis, at, sides } = self.cuts[0];
        let [mut below, mut above] = sides.map(|side| self.part(side, width));
        let axis = axis as usize;
        // The child that was split is where the row leads, as before.
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

    /// The child whose region a row is in.
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

    /// Takes what a child has lost by a split as another child.
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
        self.bound(child, width);
        self.bound(added, width);
    }

    /// Makes the box of a child tight.
    fn bound(&mut self, child: usize, width: usize) {
        for (axis, (lo, hi)) in self.children[child].bounds(width).enumerate() {
            let ends = &mut self.boxes[axis * 2 * CHILDREN..][..2 * CHILDREN];
            ends[child] = lo;
            ends[CHILDREN + child] = hi;
        }
    }

    /// Makes the box of a child hold a row.
    fn widen(&mut self, child: usize, row: &[f64]) {
        for (ends, &x) in self.boxes.chunks_exact_mut(2 * CHILDREN).zip(row) {
            ends[child] = ends[child].min(x);
            ends[CHILDREN + child] = ends[CHILDREN + child].max(x);
        }
    }

    /// A node of what lies on one side of a cut.
    fn part(&self, side: Side, width: usize) -> Self {
        let mut part = Self::empty(width);
        part.take(self, side);
        part
    }

    /// Takes what lies on one side of another node's cut; returns what side that is here.
    fn take(&mut self, from: &Self, side: Side) -> Side {
        match side {
            Side::Child(child) => {
                let (child, place) = (usize::from(child), self.children.len());
                let ends = self.boxes.chunks_exact_mut(CHILDREN);
                for (to, from) in ends.zip(from.boxes.chunks_exact(CHILDREN)) {
                    to[place] = from[child];
                }
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
