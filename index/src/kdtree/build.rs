//! Construction: the sliding midpoint.

use std::sync::Arc;

use super::{KdTree, Node, Split};
use crate::{Points, Space};

impl KdTree {
    /// As [`KdTree::new`], for a space that several trees share.
    pub(crate) fn build(space: Arc<Space>, points: Points, leaf_rows: usize) -> Self {
        let (lo, hi) = bounding_box(&points);
        let mut build = Build {
            points: &points,
            leaf_rows: leaf_rows.max(1),
            // The sliding midpoint may be as deep as the data are skewed; past this, medians bound the depth.
            sliding_depth: 32 + 2 * points.len().checked_ilog2().unwrap_or(0) as usize,
            axes: axes(&space),
            slots: (0..slot_count(&points)).collect(),
            nodes: Vec::new(),
            cell_lo: lo.clone(),
            cell_hi: hi.clone(),
            spread: Vec::new(),
            depth: 0,
        };
        build.subtree(0, points.len(), 0);
        let Build {
            slots,
            nodes,
            depth,
            ..
        } = build;
        let points = points.in_order(&slots);
        Self::assemble(space, points, nodes, (lo, hi), depth)
    }

    /// A tree that is one leaf: ready at once, searched from end to end.
    pub(crate) fn one_leaf(space: Arc<Space>, points: Points) -> Self {
        let bounds = bounding_box(&points);
        let leaf = Node::Leaf {
            start: 0,
            end: slot_count(&points),
        };
        Self::assemble(space, points, vec![leaf], bounds, 0)
    }

    fn assemble(
        space: Arc<Space>,
        points: Points,
        mut nodes: Vec<Node>,
        (lo, hi): (Vec<f64>, Vec<f64>),
        depth: usize,
    ) -> Self {
        assert_eq!(
            points.coordinates(),
            space.coordinates(),
            "rows of another space"
        );
        nodes.shrink_to_fit();
        let max_revision = points.iter().map(|point| point.revision).max().unwrap_or(0);
        Self {
            space,
            points,
            nodes,
            lo,
            hi,
            depth,
            max_revision,
        }
    }
}

fn slot_count(points: &Points) -> u32 {
    u32::try_from(points.len()).expect("a tree holds at most KdTree::MAX_POINTS points")
}

/// The least and the greatest of each coordinate; an empty interval (∞, −∞) where there are no points.
fn bounding_box(points: &Points) -> (Vec<f64>, Vec<f64>) {
    let mut lo = vec![f64::INFINITY; points.coordinates()];
    let mut hi = vec![f64::NEG_INFINITY; points.coordinates()];
    for point in points.iter() {
        for ((lo, hi), &x) in lo.iter_mut().zip(&mut hi).zip(point.row) {
            *lo = lo.min(x);
            *hi = hi.max(x);
        }
    }
    (lo, hi)
}

/// A coordinate as the build sees it.
struct Axis {
    /// The factor it belongs to.
    part: u16,
    /// What a unit of it is worth in the metric: w_g · √μ_i.
    scale: f64,
}

fn axes(space: &Space) -> Vec<Axis> {
    let mut axes = Vec::with_capacity(space.coordinates());
    for (index, part) in space.parts().iter().enumerate() {
        axes.extend((0..part.factor.coordinates()).map(|_| Axis {
            part: index as u16,
            scale: space.groups()[part.group].weight * part.weight.sqrt(),
        }));
    }
    axes
}

struct Build<'a> {
    points: &'a Points,
    leaf_rows: usize,
    sliding_depth: usize,
    axes: Vec<Axis>,
    /// The points' slots, reordered as the tree grows.
    slots: Vec<u32>,
    nodes: Vec<Node>,
    /// The cell of the subtree under construction: cut by planes, wider than the box of its points.
    cell_lo: Vec<f64>,
    cell_hi: Vec<f64>,
    /// Least and greatest coordinate of the subtree's points on each axis.
    spread: Vec<(f64, f64)>,
    depth: usize,
}

impl Build<'_> {
    /// Appends the subtree over `slots[start..end]`.
    fn subtree(&mut self, start: usize, end: usize, depth: usize) {
        self.depth = self.depth.max(depth);
        let axis = (end - start > self.leaf_rows)
            .then(|| self.cut_axis(start, end))
            .flatten();
        let Some(axis) = axis else {
            self.nodes.push(Node::Leaf {
                start: start as u32,
                end: end as u32,
            });
            return;
        };
        let (min, max) = self.spread[axis];
        let (middle, plane) = if depth < self.sliding_depth {
            self.cut_at_sliding_midpoint(start, end, axis, (min, max))
        } else {
            self.cut_at_median(start, end, axis)
        };

        let node = self.nodes.len();
        self.nodes.push(Node::Leaf { start: 0, end: 0 });
        let left_max = self.extreme(start, middle, axis, f64::max);
        let right_min = self.extreme(middle, end, axis, f64::min);

        let cell_hi = std::mem::replace(&mut self.cell_hi[axis], plane);
        self.subtree(start, middle, depth + 1);
        self.cell_hi[axis] = cell_hi;

        let right = self.nodes.len() as u32;
        let cell_lo = std::mem::replace(&mut self.cell_lo[axis], plane);
        self.subtree(middle, end, depth + 1);
        self.cell_lo[axis] = cell_lo;

        self.nodes[node] = Node::Split(Split {
            axis: axis as u16,
            part: self.axes[axis].part,
            right,
            left_max,
            right_min,
        });
    }

    /// The axis of the cell's longest side, as the metric weighs it; ties go to the largest spread of the points. None
    /// if the metric cannot tell the points apart. An axis on which the points do not spread is no choice: a plane
    /// across it would leave one side empty wherever it slides.
    fn cut_axis(&mut self, start: usize, end: usize) -> Option<usize> {
        let axes = self.axes.len();
        self.spread.clear();
        self.spread.resize(axes, (f64::INFINITY, f64::NEG_INFINITY));
        for &slot in &self.slots[start..end] {
            for ((lo, hi), &x) in self.spread.iter_mut().zip(self.points.row(slot as usize)) {
                *lo = lo.min(x);
                *hi = hi.max(x);
            }
        }
        let key = |axis: usize| {
            let (min, max) = self.spread[axis];
            let scale = self.axes[axis].scale;
            (
                scale * (self.cell_hi[axis] - self.cell_lo[axis]),
                scale * (max - min),
            )
        };
        (0..axes)
            .filter(|&axis| key(axis).1 > 0.0)
            .max_by(|&a, &b| {
                let (a, b) = (key(a), key(b));
                a.0.total_cmp(&b.0).then(a.1.total_cmp(&b.1))
            })
    }

    /// Cuts at the middle of the cell, or, where a side would be empty, at the first point on the other side.
    fn cut_at_sliding_midpoint(
        &mut self,
        start: usize,
        end: usize,
        axis: usize,
        (min, max): (f64, f64),
    ) -> (usize, f64) {
        // Halved before they are added: the sum of two large coordinates may overflow.
        let plane = (self.cell_lo[axis] / 2.0 + self.cell_hi[axis] / 2.0).clamp(min, max);
        let goes_left = |x: f64| if plane > min { x < plane } else { x <= min };
        let mut middle = start;
        for at in start..end {
            if goes_left(self.points.row(self.slots[at] as usize)[axis]) {
                self.slots.swap(at, middle);
                middle += 1;
            }
        }
        (middle, plane)
    }

    fn cut_at_median(&mut self, start: usize, end: usize, axis: usize) -> (usize, f64) {
        let half = (end - start) / 2;
        let points = self.points;
        let x = |slot: u32| points.row(slot as usize)[axis];
        self.slots[start..end].select_nth_unstable_by(half, |&a, &b| x(a).total_cmp(&x(b)));
        (start + half, x(self.slots[start + half]))
    }

    fn extreme(&self, start: usize, end: usize, axis: usize, pick: fn(f64, f64) -> f64) -> f64 {
        self.slots[start..end]
            .iter()
            .map(|&slot| self.points.row(slot as usize)[axis])
            .reduce(pick)
            .expect("a cut leaves points on both sides")
    }
}
