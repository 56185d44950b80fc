//! The query: nearer child first, cells skipped by the incremental bound.
//!
//! The bound of a cell is the metric with each factor's distance replaced by the distance from the state to the
//! factor's part of the cell: |x − [a, b]| on a line, the shorter way around on a circle, the nearer of q and −q for a
//! rotation. A cut touches one factor, so only that factor's term changes from a cell to its child (the paper, with
//! the weight it leaves out): d²(R₂) = d²(R₁) + μ_K · (d²_K(R₂) − d²_K(R₁)).
//!
//! **Rounding.** Each term is computed by the operations of the distance itself on no greater operands, and rounding
//! is monotone, so a term never exceeds its counterpart in the distance of a point of the cell (a rotation's series
//! may, by a few units in the last place). What differs is the order of summation: at most `coordinates` additions in
//! the distance, and two operations for each cut on the path, each off by at most one half ε of a sum that only grows.
//! The sums are lowered by more than that before they are composed, and by the least normal number besides, below
//! which errors are not relative.

use super::{KdTree, Node, Split};
use crate::{
    search::{Cell, Walk},
    space::{Factor, Part, real_vector, so2, so3},
};

/// What a state's path from the root to a cell has established.
struct Descent<'t, 'w, 'a, V> {
    tree: &'t KdTree,
    walk: &'w mut Walk<'a>,
    /// Whether the point in a slot takes part.
    visible: V,
    cell: Cell,
    /// Lowers a sum of terms to what is surely a bound.
    margin: f64,
}

impl KdTree {
    /// Shows `walk` every visible point that can matter to it.
    pub(crate) fn visit(&self, walk: &mut Walk<'_>, visible: impl Fn(usize) -> bool) {
        if self.is_empty()
            || (walk.since_revision() > 0 && self.max_revision <= walk.since_revision())
        {
            return;
        }
        let mut cell = std::mem::take(&mut walk.cell);
        cell.lo.clone_from(&self.lo);
        cell.hi.clone_from(&self.hi);
        cell.terms.clear();
        cell.terms.resize(self.lo.len(), 0.0);
        cell.sums.clear();
        cell.sums.resize(self.space.groups().len(), 0.0);
        let roundings = 4 * (cell.terms.len() + self.depth) + 64;
        let mut descent = Descent {
            tree: self,
            walk,
            visible,
            cell,
            margin: 1.0 - f64::EPSILON * roundings as f64,
        };
        descent.enter_root();
        descent.walk.cell = descent.cell;
    }
}

impl<V: Fn(usize) -> bool> Descent<'_, '_, '_, V> {
    fn enter_root(&mut self) {
        for part in self.tree.space.parts() {
            let axes = match part.factor {
                Factor::RealVector(n) => n,
                Factor::SO2 { .. } | Factor::SO3 => 1,
            };
            for axis in part.offset..part.offset + axes {
                let (first, term) = self.term(part, axis);
                self.cell.terms[first] = term;
                self.cell.sums[part.group] += term;
            }
        }
        if !self.walk.skips(self.bound()) {
            self.node(0);
        }
    }

    fn node(&mut self, index: usize) {
        match self.tree.nodes[index] {
            Node::Leaf { start, end } => self.leaf(start as usize, end as usize),
            Node::Split(split) => self.split(index, split),
        }
    }

    fn leaf(&mut self, start: usize, end: usize) {
        if !self.walk.enters_leaf() {
            return;
        }
        for slot in start..end {
            if (self.visible)(slot) {
                self.walk.consider(self.tree.points.get(slot));
            }
        }
    }

    fn split(&mut self, index: usize, split: Split) {
        let Split {
            left_max,
            right_min,
            ..
        } = split;
        let axis = split.axis as usize;
        let tree = self.tree;
        let part = &tree.space.parts()[split.part as usize];
        let (lo, hi) = (self.cell.lo[axis], self.cell.hi[axis]);

        self.cell.hi[axis] = left_max;
        let (first, left_term) = self.term(part, axis);
        self.cell.hi[axis] = hi;
        self.cell.lo[axis] = right_min;
        let (_, right_term) = self.term(part, axis);
        self.cell.lo[axis] = lo;

        let (term, sum) = (self.cell.terms[first], self.cell.sums[part.group]);
        let left = (index + 1, left_term, (lo, left_max));
        let right = (split.right as usize, right_term, (right_min, hi));
        let children = if left_term <= right_term {
            [left, right]
        } else {
            [right, left]
        };
        for (child, child_term, cell) in children {
            self.cell.terms[first] = child_term;
            self.cell.sums[part.group] = sum + (child_term - term);
            if !self.walk.skips(self.bound()) {
                (self.cell.lo[axis], self.cell.hi[axis]) = cell;
                self.node(child);
                (self.cell.lo[axis], self.cell.hi[axis]) = (lo, hi);
            }
        }
        self.cell.terms[first] = term;
        self.cell.sums[part.group] = sum;
    }

    /// The weighted squared distance from the state to the current cell in the part that `axis` belongs to (for a
    /// vector: along that axis alone), and the axis at which that term stands.
    fn term(&self, part: &Part, axis: usize) -> (usize, f64) {
        let state = self.walk.state;
        let (first, distance_2) = match part.factor {
            Factor::RealVector(_) => {
                let d = real_vector::bound(state[axis], self.cell.lo[axis], self.cell.hi[axis]);
                (axis, d * d)
            }
            Factor::SO2 { period } => {
                let d = so2::bound(state[axis], self.cell.lo[axis], self.cell.hi[axis], period);
                (axis, d * d)
            }
            Factor::SO3 => {
                let axes = part.offset..part.offset + 4;
                let d_2 = so3::bound_2(
                    &state[axes.clone()],
                    &self.cell.lo[axes.clone()],
                    &self.cell.hi[axes],
                );
                (part.offset, d_2)
            }
        };
        (first, part.weight * distance_2)
    }

    /// A lower bound on the reported distance of every point of the current cell.
    fn bound(&self) -> f64 {
        let lowered = self
            .cell
            .sums
            .iter()
            .map(|sum| (sum * self.margin - f64::MIN_POSITIVE).max(0.0));
        self.tree.space.compose(lowered)
    }
}
