//! Construction: cuts at medians that leave every leaf full.
//!
//! All leaves are equally deep, and nodes are full at the bottom, where a search meets most of them; what does not
//! divide by sixteen is left to the top. A cut goes across the coordinate in which the points spread most, as the metric
//! weighs it.

use std::{ops::Range, sync::Arc};

use super::{KdTree, Node, reach::Reach, rounded::Rounded};
use crate::{
    Points, Space,
    blocks::Blocks,
    kernel::{BLOCK, CHILDREN, Scale},
};

/// So many points tell in which coordinate a larger set spreads most.
const SAMPLE: usize = 256;

impl KdTree {
    /// As [`KdTree::new`], for a space that several trees share and points that were checked.
    pub(crate) fn build(space: Arc<Space>, points: Points, leaf_rows: usize) -> Self {
        debug_assert_eq!(points.check(&space), Ok(()));
        let leaf_rows = leaf_rows.max(1);
        let leaves = points.len().div_ceil(leaf_rows);
        let height = height(leaves);
        let mut build = Build {
            points: &points,
            leaf_rows,
            scales: scales(&space),
            slots: (0..points.len() as u32).collect(),
            keys: Vec::new(),
            nodes: Vec::new(),
            boxes: Vec::new(),
        };
        if height > 0 {
            build.add_nodes(1);
            build.node(0, 0..leaves, height);
        }
        let Build {
            slots,
            mut nodes,
            mut boxes,
            ..
        } = build;
        nodes.shrink_to_fit();
        boxes.shrink_to_fit();
        let blocks = blocks(&points, &slots, leaf_rows);
        // (A single leaf is to be ready at once.)
        let is_tree = leaves > 1;
        Self {
            labels: points.labels_in_order(&slots),
            rounded: is_tree
                .then(|| Rounded::where_it_helps(&space, &points, &blocks))
                .flatten(),
            blocks,
            max_revision: points.iter().map(|point| point.revision).max().unwrap_or(0),
            scale: Scale::new(&space),
            space,
            leaf_rows,
            height,
            nodes,
            boxes,
            reach: Reach::default(),
        }
    }

    /// A tree that is one leaf: ready at once, searched from end to end.
    pub(crate) fn one_leaf(space: Arc<Space>, points: Points) -> Self {
        let leaf_rows = points.len();
        Self::build(space, points, leaf_rows)
    }
}

/// How many full nodes lie one below the other over so many leaves.
fn height(leaves: usize) -> u32 {
    let mut height = 0;
    while leaves > capacity(height) || (height == 0 && leaves > 0) {
        height += 1;
    }
    height
}

/// How many leaves a subtree of this height has at most.
fn capacity(height: u32) -> usize {
    CHILDREN.pow(height)
}

/// What a unit of each coordinate is worth in the metric: w_g · √μ_i.
pub(crate) fn scales(space: &Space) -> Vec<f64> {
    let mut scales = Vec::with_capacity(space.coordinates());
    for part in space.parts() {
        let scale = space.groups()[part.group].weight * part.weight.sqrt();
        scales.extend((0..part.factor.coordinates()).map(|_| scale));
    }
    scales
}

/// The rows of each leaf, which begins a block.
fn blocks(points: &Points, slots: &[u32], leaf_rows: usize) -> Blocks {
    let places = leaf_rows.next_multiple_of(BLOCK);
    let leaves = slots.chunks(leaf_rows);
    let mut blocks = Blocks::with_capacity(points.coordinates(), leaves.len() * places);
    for (leaf, slots) in leaves.enumerate() {
        for (place, &slot) in slots.iter().enumerate() {
            blocks.write(leaf * places + place, points.row(slot as usize));
        }
    }
    blocks
}

struct Build<'a> {
    points: &'a Points,
    leaf_rows: usize,
    scales: Vec<f64>,
    /// The points' slots, reordered as the tree grows.
    slots: Vec<u32>,
    /// The coordinates that a cut goes by, and the slots they belong to.
    keys: Vec<(f64, u32)>,
    nodes: Vec<Node>,
    boxes: Vec<f64>,
}

impl Build<'_> {
    /// Appends empty nodes; returns the place of the first.
    fn add_nodes(&mut self, count: usize) -> usize {
        let first = self.nodes.len();
        let width = self.scales.len() * 2 * CHILDREN;
        self.nodes
            .resize(first + count, Node { first: 0, count: 0 });
        self.boxes.resize((first + count) * width, 0.0);
        first
    }

    /// Makes the subtree of these leaves under the node at `index`.
    fn node(&mut self, index: usize, leaves: Range<usize>, height: u32) {
        let count = leaves.len().div_ceil(capacity(height - 1));
        let mut ends = Vec::with_capacity(count);
        // In whole bottom nodes, unless these are what is cut.
        let unit = if height > 1 { CHILDREN } else { 1 };
        self.cut(leaves.clone(), count, unit, &mut ends);

        let first = if height > 1 {
            self.add_nodes(count)
        } else {
            leaves.start
        };
        let mut start = leaves.start;
        for (child, &end) in ends.iter().enumerate() {
            if height > 1 {
                self.node(first + child, start..end, height - 1);
                self.bound_node(index, child, first + child);
            } else {
                self.bound_leaf(index, child, start);
            }
            start = end;
        }
        self.nodes[index] = Node {
            first: first as u32,
            count: count as u32,
        };
    }

    /// Divides leaves among `children`, and pushes where each child ends.
    fn cut(&mut self, leaves: Range<usize>, children: usize, unit: usize, ends: &mut Vec<usize>) {
        if children == 1 {
            ends.push(leaves.end);
            return;
        }
        let left = children / 2;
        let share = (leaves.len() * left).div_ceil(children);
        let middle = leaves.start + share.next_multiple_of(unit);
        self.partition(self.rows(&leaves), middle * self.leaf_rows);
        self.cut(leaves.start..middle, left, unit, ends);
        self.cut(middle..leaves.end, children - left, unit, ends);
    }

    /// The places in `slots` of some leaves' points.
    fn rows(&self, leaves: &Range<usize>) -> Range<usize> {
        leaves.start * self.leaf_rows..(leaves.end * self.leaf_rows).min(self.slots.len())
    }

    /// Brings the points that are least in the widest coordinate before `middle`, and the others behind.
    fn partition(&mut self, rows: Range<usize>, middle: usize) {
        let axis = self.widest(rows.clone());
        let points = self.points;
        self.keys.clear();
        let slots = &mut self.slots[rows.clone()];
        self.keys.extend(
            slots
                .iter()
                .map(|&slot| (points.row(slot as usize)[axis], slot)),
        );
        self.keys
            .select_nth_unstable_by(middle - rows.start, |a, b| a.0.total_cmp(&b.0));
        for (slot, key) in slots.iter_mut().zip(&self.keys) {
            *slot = key.1;
        }
    }

    /// The coordinate in which the points, or a sample of them, spread most.
    fn widest(&self, rows: Range<usize>) -> usize {
        let width = self.scales.len();
        let (mut lo, mut hi) = (vec![f64::INFINITY; width], vec![f64::NEG_INFINITY; width]);
        let step = (rows.len() / SAMPLE).max(1);
        for &slot in self.slots[rows].iter().step_by(step) {
            widen(&mut lo, &mut hi, self.points.row(slot as usize));
        }
        let spread = |axis: usize| self.scales[axis] * (hi[axis] - lo[axis]);
        (0..width)
            .max_by(|&a, &b| spread(a).total_cmp(&spread(b)))
            .unwrap_or(0)
    }

    /// Writes the box of a leaf into the `child`-th place of the node at `index`.
    fn bound_leaf(&mut self, index: usize, child: usize, leaf: usize) {
        let width = self.scales.len();
        let (mut lo, mut hi) = (vec![f64::INFINITY; width], vec![f64::NEG_INFINITY; width]);
        for &slot in &self.slots[self.rows(&(leaf..leaf + 1))] {
            widen(&mut lo, &mut hi, self.points.row(slot as usize));
        }
        self.write_box(index, child, &lo, &hi);
    }

    /// Writes the box of a node into the `child`-th place of its parent.
    fn bound_node(&mut self, parent: usize, child: usize, node: usize) {
        let width = self.scales.len();
        let count = self.nodes[node].count as usize;
        let ends = &self.boxes[node * width * 2 * CHILDREN..][..width * 2 * CHILDREN];
        let ends = ends.chunks_exact(2 * CHILDREN);
        let least = |x: &[f64]| x[..count].iter().copied().fold(f64::INFINITY, f64::min);
        let greatest = |x: &[f64]| x[..count].iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let (lo, hi): (Vec<f64>, Vec<f64>) = ends
            .map(|ends| (least(ends), greatest(&ends[CHILDREN..])))
            .unzip();
        self.write_box(parent, child, &lo, &hi);
    }

    fn write_box(&mut self, node: usize, child: usize, lo: &[f64], hi: &[f64]) {
        let width = lo.len() * 2 * CHILDREN;
        let ends = self.boxes[node * width..][..width].chunks_exact_mut(2 * CHILDREN);
        for (ends, (&lo, &hi)) in ends.zip(lo.iter().zip(hi)) {
            ends[child] = lo;
            ends[CHILDREN + child] = hi;
        }
    }
}

/// Makes a box hold a row.
fn widen(lo: &mut [f64], hi: &mut [f64], row: &[f64]) {
    for ((lo, hi), &x) in lo.iter_mut().zip(hi).zip(row) {
        *lo = lo.min(x);
        *hi = hi.max(x);
    }
}
