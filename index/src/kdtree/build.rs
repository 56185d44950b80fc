//! Construction: cuts at medians that leave every leaf full.
//!
//! All leaves are equally deep, and nodes are full at the bottom, where a search visits most of them; the remainder of
//! the division by sixteen goes to the top. A cut crosses the coordinate in which the points spread most, in the
//! metric.

use std::{ops::Range, sync::Arc};

use super::{KdTree, Node};
use crate::{
    Points, Space,
    blocks::Blocks,
    boxes::{Boxes, around_rows},
    kernel::KeyMap,
    lanes::{BLOCK_ROWS, MAX_CHILDREN},
    quantize::QuantizedRows,
    scan_policy::ScanPolicy,
};

/// The least number of points of a larger set that are looked at to find the coordinate in which it spreads most.
const SAMPLE: usize = 64;

impl KdTree {
    /// Acts like [`KdTree::new`], but takes points that were checked, and a space that several trees share.
    pub(crate) fn build(space: Arc<Space>, points: &Points, leaf_rows: usize) -> Self {
        debug_assert_eq!(points.check(&space), Ok(()));
        // Each leaf reserves this many rows.
        let leaf_rows = leaf_rows.clamp(1, points.len().max(1));
        let leaves = points.len().div_ceil(leaf_rows);
        let height = height(leaves);
        let mut build = Build {
            points,
            leaf_rows,
            unit_lengths: space.unit_lengths(),
            slots: (0..points.len() as u32).collect(),
            keys: Vec::new(),
            nodes: Vec::new(),
            boxes: Boxes::new(space.coordinates(), 0),
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
        let blocks = blocks(points, &slots, leaf_rows);
        // A single leaf must be ready at once, so it gets no codes.
        let quantized = (leaves > 1)
            .then(|| QuantizedRows::where_they_pay(&space, points, &blocks))
            .flatten();
        Self {
            labels: points.labels_in_order(&slots),
            quantized,
            blocks,
            newest: points.newest(),
            key_map: KeyMap::new(&space),
            space,
            leaf_rows,
            height,
            nodes,
            boxes,
            scan_policy: ScanPolicy::default(),
        }
    }
}

/// The number of nodes one below the other over this number of leaves.
fn height(leaves: usize) -> u32 {
    let mut height = 0;
    while leaves > capacity(height) || (height == 0 && leaves > 0) {
        height += 1;
    }
    height
}

/// The greatest number of leaves of a subtree of this height.
fn capacity(height: u32) -> usize {
    MAX_CHILDREN.pow(height)
}

/// The rows in the order of the leaves; each leaf begins a block.
fn blocks(points: &Points, slots: &[u32], leaf_rows: usize) -> Blocks {
    let places = leaf_rows.next_multiple_of(BLOCK_ROWS);
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
    unit_lengths: Vec<f64>,
    /// The slots of the points, reordered as the tree grows.
    slots: Vec<u32>,
    /// The numbers that a cut compares, with their slots.
    keys: Vec<(f64, u32)>,
    nodes: Vec<Node>,
    boxes: Boxes,
}

impl Build<'_> {
    /// Appends empty nodes; returns the index of the first.
    fn add_nodes(&mut self, count: usize) -> usize {
        let first = self.nodes.len();
        self.nodes
            .resize(first + count, Node { first: 0, count: 0 });
        self.boxes.add_nodes(count);
        first
    }

    /// Builds the subtree of these leaves under the node at `index`.
    fn node(&mut self, index: usize, leaves: Range<usize>, height: u32) {
        let count = leaves.len().div_ceil(capacity(height - 1));
        let mut ends = Vec::with_capacity(count);
        // Above the bottom a cut keeps bottom nodes whole.
        let unit = if height > 1 { MAX_CHILDREN } else { 1 };
        self.cut(leaves.clone(), count, unit, &mut ends);

        let first = if height > 1 {
            self.add_nodes(count)
        } else {
            leaves.start
        };
        let mut start = leaves.start;
        for (child, &end) in ends.iter().enumerate() {
            if height > 1 {
                let node = first + child;
                self.node(node, start..end, height - 1);
                let count = self.nodes[node].count as usize;
                let axes = 0..self.unit_lengths.len();
                let ends: Vec<_> = axes
                    .map(|axis| self.boxes.around_children(node, count, axis))
                    .collect();
                self.boxes.set(index, child, ends.into_iter());
            } else {
                let (lo, hi) = self.around(self.rows(&(start..start + 1)), 1);
                self.boxes.set(index, child, lo.into_iter().zip(hi));
            }
            start = end;
        }
        self.nodes[index] = Node {
            first: first as u32,
            count: count as u32,
        };
    }

    /// Divides leaves among `children`, and pushes the end of each child.
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

    /// The places in `slots` of the points of some leaves.
    fn rows(&self, leaves: &Range<usize>) -> Range<usize> {
        leaves.start * self.leaf_rows..(leaves.end * self.leaf_rows).min(self.slots.len())
    }

    /// Moves the points with the least numbers in the widest coordinate before `middle`, and the others behind it.
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
        let step = (rows.len() / SAMPLE).max(1);
        let (lo, hi) = self.around(rows, step);
        let spread = |axis: usize| self.unit_lengths[axis] * (hi[axis] - lo[axis]);
        (0..lo.len())
            .max_by(|&a, &b| spread(a).total_cmp(&spread(b)))
            .unwrap_or(0)
    }

    /// The ends of the smallest box around one in `step` of some points.
    fn around(&self, rows: Range<usize>, step: usize) -> (Vec<f64>, Vec<f64>) {
        let slots = self.slots[rows].iter().step_by(step);
        let rows = slots.map(|&slot| self.points.row(slot as usize));
        around_rows(self.unit_lengths.len(), rows)
    }
}
