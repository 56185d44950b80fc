//! The query: depth first, the nearer child first, with incremental bounds.
//!
//! **Rounding.** A coordinate's distance to an interval uses the operations of the distance to a point, which are
//! monotone. Increments are at least 0 and telescope, and [`sum_down`] rounds each sum down, so a bound exceeds the
//! exact sum by no more than the margin that [`KeyMap::limit`](crate::kernel::KeyMap::limit) leaves. A cell whose
//! bound equals the worst distance is visited: one of its points may have a smaller id.

use std::{array::from_fn, collections::BinaryHeap, ops::Range, time::Instant};

use super::{Axis, Mpnn, Node};
use crate::{
    Answer, Factor, Neighbor, Search, SearchError,
    space::{real_vector, so2, so3},
    traversal::LEAVES_PER_CLOCK_READ,
};

/// Answers a search for a canonical state.
pub(super) fn search(
    tree: &Mpnn,
    state: &[f64],
    search: &Search<'_>,
) -> Result<Answer, SearchError> {
    let mut query = Query::new(tree, state, search);
    if !tree.is_empty() {
        query.run()?;
    }
    Ok(Answer {
        neighbors: query.nearest.into_sorted_vec(),
    })
}

/// A step down or up the tree: one side of a cell, and the bounds that follow from it.
#[derive(Clone, Copy, Debug)]
struct Step {
    to: Move,
    axis: u32,
    lo: f64,
    hi: f64,
    /// d²_K(R).
    factor_2: f64,
    /// Σ μ·d² of the group.
    group_2: f64,
    key: f64,
}

#[derive(Clone, Copy, Debug)]
enum Move {
    /// To the node with this index.
    Enter(u32),
    /// To the parent, after both children.
    Return,
}

/// A search under way in the cell R.
struct Query<'a> {
    tree: &'a Mpnn,
    state: &'a [f64],
    search: &'a Search<'a>,
    /// The cell.
    lo: Vec<f64>,
    hi: Vec<f64>,
    /// d²_K(R), at the first coordinate of each factor.
    factors_2: Vec<f64>,
    /// Σ_K μ_K·d²_K(R), by group.
    groups_2: Vec<f64>,
    /// The bound of R, as a key of [`KeyMap`]: the group's sum where there is one group, else the distance.
    key: f64,
    nearest: BinaryHeap<Neighbor>,
    /// A greater key is farther than the worst neighbour.
    limit: f64,
    /// A greater key is given up for `epsilon`.
    epsilon_limit: f64,
    epsilon_factor: f64,
    leaves_visited: usize,
}

impl<'a> Query<'a> {
    /// At the root.
    fn new(tree: &'a Mpnn, state: &'a [f64], search: &'a Search<'a>) -> Self {
        let mut query = Self {
            tree,
            state,
            search,
            lo: tree.lo.clone(),
            hi: tree.hi.clone(),
            factors_2: vec![0.0; tree.axes.len()],
            groups_2: vec![0.0; tree.space.groups().len()],
            key: 0.0,
            nearest: BinaryHeap::new(),
            limit: 0.0,
            epsilon_limit: 0.0,
            epsilon_factor: tree.key_map.epsilon_factor(search.epsilon),
            leaves_visited: 0,
        };
        query.tighten();
        // The bound of the root, factor by factor: no node is entered.
        for (axis, factor) in tree.axes.iter().enumerate() {
            if factor.first == axis {
                query.take(query.step(Move::Enter(0), axis, tree.lo[axis], tree.hi[axis]));
            }
        }
        query
    }

    fn run(&mut self) -> Result<(), SearchError> {
        let root = self.step(Move::Enter(0), 0, self.lo[0], self.hi[0]);
        let mut open = vec![root];
        while let Some(step) = open.pop() {
            let Move::Enter(node) = step.to else {
                self.take(step);
                continue;
            };
            if step.key > self.limit || step.key > self.epsilon_limit {
                continue;
            }
            self.take(step);
            match self.tree.nodes[node as usize] {
                Node::Leaf { start, end } => self.scan(start as usize..end as usize)?,
                Node::Split { axis, high, cut } => {
                    let at = axis as usize;
                    let (lo, hi) = (self.lo[at], self.hi[at]);
                    let (low, high) = (
                        self.step(Move::Enter(node + 1), at, lo, cut),
                        self.step(Move::Enter(high), at, cut, hi),
                    );
                    let low_is_near =
                        low.key < high.key || low.key == high.key && self.state[at] < cut;
                    let (near, far) = if low_is_near {
                        (low, high)
                    } else {
                        (high, low)
                    };
                    open.push(self.step_back(at));
                    open.extend([far, near].iter().filter(|child| child.key <= self.limit));
                }
            }
        }
        Ok(())
    }

    /// The step that comes back to the current cell from either side of a cut.
    fn step_back(&self, axis: usize) -> Step {
        let of = &self.tree.axes[axis];
        Step {
            to: Move::Return,
            axis: axis as u32,
            lo: self.lo[axis],
            hi: self.hi[axis],
            factor_2: self.factors_2[of.first],
            group_2: self.groups_2[of.group],
            key: self.key,
        }
    }

    /// The step to one side of the current cell, with its incremental bound.
    fn step(&self, to: Move, axis: usize, lo: f64, hi: f64) -> Step {
        let of = &self.tree.axes[axis];
        let mut step = Step {
            to,
            lo,
            hi,
            ..self.step_back(axis)
        };
        let (factor_2, group_2) = (self.factor_2(axis, lo, hi), step.group_2);
        if factor_2 > step.factor_2 {
            step.group_2 = sum_down(group_2, of.weight * (factor_2 - step.factor_2));
            step.factor_2 = factor_2;
            step.key = match self.tree.space.groups() {
                [_] => step.group_2,
                groups => {
                    let grown = step.group_2.sqrt() - group_2.sqrt();
                    sum_down(step.key, groups[of.group].weight * grown)
                }
            };
        }
        step
    }

    fn take(&mut self, step: Step) {
        let axis = step.axis as usize;
        let of = &self.tree.axes[axis];
        (self.lo[axis], self.hi[axis]) = (step.lo, step.hi);
        self.factors_2[of.first] = step.factor_2;
        self.groups_2[of.group] = step.group_2;
        self.key = step.key;
    }

    /// d²_K to the current cell cut down to one side, a lower bound of the factor's squared distance to every point in
    /// it.
    fn factor_2(&self, axis: usize, lo: f64, hi: f64) -> f64 {
        let Axis { factor, first, .. } = self.tree.axes[axis];
        let x = self.state[axis];
        match factor {
            Factor::RealVector(_) => real_vector::to_interval_2(x, lo, hi),
            Factor::SO2 { period } => so2::to_interval_2(x, period, lo, hi),
            Factor::SO3 => {
                let cell = |ends: &[f64], end| {
                    from_fn(|i| match first + i == axis {
                        true => end,
                        false => ends[first + i],
                    })
                };
                let state = &self.state[first..first + 4];
                so3::to_box_2(state, cell(&self.lo, lo), cell(&self.hi, hi))
            }
        }
    }

    /// Measures the points of a leaf.
    fn scan(&mut self, slots: Range<usize>) -> Result<(), SearchError> {
        let search = self.search;
        for point in slots.map(|slot| self.tree.points.get(slot)) {
            if !search.filter.admits(point.tag, point.revision) || search.excludes(point.id) {
                continue;
            }
            let neighbor = Neighbor {
                distance: self.tree.space.distance(self.state, point.row),
                id: point.id,
            };
            if neighbor.distance > search.radius {
                continue;
            }
            if self.nearest.len() < search.k {
                self.nearest.push(neighbor);
            } else if let Some(mut worst) = self.nearest.peek_mut()
                && neighbor < *worst
            {
                *worst = neighbor;
            } else {
                continue;
            }
            if self.nearest.len() == search.k {
                self.tighten();
            }
        }
        self.leaves_visited += 1;
        if let Some(until) = search.until
            && self.leaves_visited.is_multiple_of(LEAVES_PER_CLOCK_READ)
            && Instant::now() >= until
        {
            return Err(SearchError::TimedOut);
        }
        Ok(())
    }

    /// Lowers the limits to the worst neighbour once there are k.
    fn tighten(&mut self) {
        let worst = if self.nearest.len() < self.search.k {
            self.search.radius
        } else {
            let worst = self.nearest.peek();
            worst.map_or(f64::NEG_INFINITY, |worst| worst.distance)
        };
        self.limit = self.tree.key_map.limit(worst);
        self.epsilon_limit = self.limit * self.epsilon_factor;
    }
}

/// A lower bound of `sum + weight · increment`, given the rounded product; all are at least 0. One step down undoes the
/// rounding up of both the product and the sum.
fn sum_down(sum: f64, product: f64) -> f64 {
    (sum + product).next_down().max(sum)
}
