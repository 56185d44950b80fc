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

use super::{KdTree, Node};
use crate::{
    search::Walk,
    space::{Factor, Part, real_vector, so2, so3},
};

/// What a state's path from the root to a cell has established.
struct Descent<'t, 'w, 'a, V> {
    tree: &'t KdTree,
    walk: &'w mut Walk<'a>,
    /// Whether the point in a slot takes part.
    visible: V,
    /// The part that each axis belongs to.
    part_of: Vec<u16>,
    /// The current cell.
    lo: Vec<f64>,
    hi: Vec<f64>,
    /// Each axis' weighted squared term; a rotation's stands at its first axis.
    terms: Vec<f64>,
    /// The sum of the terms of each group.
    sums: Vec<f64>,
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
        let space = &*self.space;
        let coordinates = space.coordinates();
        let mut part_of = Vec::with_capacity(coordinates);
        for (index, part) in space.parts().iter().enumerate() {
            part_of.extend(std::iter::repeat_n(index as u16, part.factor.coordinates()));
        }
        let mut descent = Descent {
            tree: self,
            walk,
            visible,
            part_of,
            lo: self.lo.clone(),
            hi: self.hi.clone(),
            terms: vec![0.0; coordinates],
            sums: vec![0.0; space.groups().len()],
            margin: 1.0 - f64::EPSILON * (4 * (coordinates + self.depth) + 64) as f64,
        };
        descent.enter_root();
    }
}

impl<V: Fn(usize) -> bool> Descent<'_, '_, '_, V> {
    fn enter_root(&mut self) {
        let mut axis = 0;
        while axis < self.terms.len() {
            let part = &self.tree.space.parts()[self.part_of[axis] as usize];
            let (first, term) = self.term(part, axis);
            self.terms[first] = term;
            self.sums[part.group] += term;
            axis += match part.factor {
                Factor::SO3 => 4,
                Factor::RealVector(_) | Factor::SO2 { .. } => 1,
            };
        }
        if !self.walk.skips(self.bound()) {
            self.node(0);
        }
    }

    fn node(&mut self, index: usize) {
        match self.tree.nodes[index] {
            Node::Leaf { start, end } => self.leaf(start as usize, end as usize),
            Node::Split {
                axis,
                right,
                left_max,
                right_min,
            } => self.split(index, axis as usize, right as usize, left_max, right_min),
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

    fn split(&mut self, index: usize, axis: usize, right: usize, left_max: f64, right_min: f64) {
        let tree = self.tree;
        let part = &tree.space.parts()[self.part_of[axis] as usize];
        let (lo, hi) = (self.lo[axis], self.hi[axis]);

        self.hi[axis] = left_max;
        let (first, left_term) = self.term(part, axis);
        self.hi[axis] = hi;
        self.lo[axis] = right_min;
        let (_, right_term) = self.term(part, axis);
        self.lo[axis] = lo;

        let (term, sum) = (self.terms[first], self.sums[part.group]);
        let left = (index + 1, left_term, (lo, left_max));
        let right = (right, right_term, (right_min, hi));
        let children = if left_term <= right_term {
            [left, right]
        } else {
            [right, left]
        };
        for (child, child_term, cell) in children {
            self.terms[first] = child_term;
            self.sums[part.group] = sum + (child_term - term);
            if !self.walk.skips(self.bound()) {
                (self.lo[axis], self.hi[axis]) = cell;
                self.node(child);
                (self.lo[axis], self.hi[axis]) = (lo, hi);
            }
        }
        self.terms[first] = term;
        self.sums[part.group] = sum;
    }

    /// The weighted squared distance from the state to the current cell in the part that `axis` belongs to (for a
    /// vector: along that axis alone), and the axis at which that term stands.
    fn term(&self, part: &Part, axis: usize) -> (usize, f64) {
        let state = self.walk.state;
        let (first, distance_2) = match part.factor {
            Factor::RealVector(_) => {
                let d = real_vector::bound(state[axis], self.lo[axis], self.hi[axis]);
                (axis, d * d)
            }
            Factor::SO2 { period } => {
                let d = so2::bound(state[axis], self.lo[axis], self.hi[axis], period);
                (axis, d * d)
            }
            Factor::SO3 => {
                let axes = part.offset..part.offset + 4;
                let d_2 =
                    so3::bound_2(&state[axes.clone()], &self.lo[axes.clone()], &self.hi[axes]);
                (part.offset, d_2)
            }
        };
        (first, part.weight * distance_2)
    }

    /// A lower bound on the reported distance of every point of the current cell.
    fn bound(&self) -> f64 {
        let lowered = self
            .sums
            .iter()
            .map(|sum| (sum * self.margin - f64::MIN_POSITIVE).max(0.0));
        self.tree.space.compose(lowered)
    }
}
