//! The kd-tree of Yershova and LaValle as their paper describes it, for comparison with [`KdTree`](crate::KdTree).
//!
//! Source: A. Yershova, S. M. LaValle, "Improving Motion Planning Algorithms by Efficient Nearest-Neighbor Searching",
//! IEEE Transactions on Robotics 23(1), 2007. Its library MPNN extends ANN, by Mount and Arya, to products of R, S¹ and
//! RP³.
//!
//! - **Construction.** The tree is built in the un-identified space: an interval for each circle, R⁴ for each rotation.
//!   The root cell encloses the points. A *sliding midpoint* splits a cell: the plane cuts the longest side at its
//!   middle, and slides to the first point when one half would be empty. Among equal sides, it cuts the one with the
//!   largest point spread.
//! - **Query.** Identifications enter only here. With p the state and R a cell, the distance in the factor K is
//!   d_R(p, \[a, b\]), dist_S¹(p, \[a, b\]) = min over both ways around the circle, or the smaller angle to R from p
//!   and −p. A split changes the distance of one factor, so a cell R₂ within R₁ is bounded *incrementally*:
//!
//! > d²(R₂) = d²(R₁) + μ_K · (d²_K(R₂) − d²_K(R₁))
//!
//! The paper's formula leaves out the weight μ_K, and a weight below 1 would then prune true neighbours. In a sum of
//! groups the same step updates the squared sum of the group g, and the bound grows by w_g · (√d²_g(R₂) − √d²_g(R₁)).

mod query;
mod validate;

use crate::{
    Answer, Factor, Points, PointsError, Search, SearchError, Space, boxes::around_rows,
    kernel::KeyMap,
};

/// Sides count as equally long when they differ by this share of the longest (the tolerance that ANN uses).
const SIDE_TOLERANCE: f64 = 0.001;

/// One coordinate of a row, and the factor K whose distance a cut across it changes. Each coordinate of R^n is a factor
/// R.
#[derive(Clone, Copy, Debug)]
struct Axis {
    factor: Factor,
    /// The first coordinate of the factor; four coordinates share it in `SO3`.
    first: usize,
    /// μ_K.
    weight: f64,
    group: usize,
    /// The length of a unit of this coordinate in the metric: w_g · √μ_K.
    unit_length: f64,
}

#[derive(Clone, Copy, Debug)]
enum Node {
    /// The points in these slots.
    Leaf { start: u32, end: u32 },
    /// The low child is the next node, with coordinates up to `cut`; the high child has those from `cut` on.
    Split { axis: u32, high: u32, cut: f64 },
}

/// The static kd-tree of the paper: binary nodes, sliding midpoints, incremental bounds, scalar arithmetic.
///
/// It answers every [`Search`] as [`Linear`](crate::Linear) does, in ids and in the bits of the distances. Use
/// [`KdTree`](crate::KdTree) or [`Forest`](crate::Forest) for speed.
///
/// Construction takes O(d·n) for each level of the tree, O(d·n·log n) unless the points crowd towards a corner; the
/// tree takes O(d·n) space. A query takes O(1) for each node in R^n and S¹, and for each rotation four coordinates of p
/// and −p.
///
/// ```
/// use wayfold_index::{Mpnn, Points, Search, Space};
///
/// let space: Space = "R2*SO2".parse()?;
/// let mut points = Points::new(space.coordinates());
/// points.push(1, 0, 1, &[0.0, 0.0, 3.1]);
/// points.push(2, 0, 1, &[0.0, 0.0, -3.1]);
/// points.push(3, 0, 1, &[0.0, 0.5, 2.9]);
/// let tree = Mpnn::new(space, points, 1)?;
/// // Across the seam of the circle.
/// let answer = tree.search(&[0.0, 0.0, -3.0], &Search::nearest_k(2))?;
/// assert_eq!([answer.neighbors[0].id, answer.neighbors[1].id], [2, 1]);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Clone, Debug)]
pub struct Mpnn {
    space: Space,
    key_map: KeyMap,
    /// By coordinate.
    axes: Vec<Axis>,
    leaf_rows: usize,
    /// In the order of the leaves.
    points: Points,
    /// The root first, a low child after its parent; empty without points.
    nodes: Vec<Node>,
    /// The root cell, by coordinate.
    lo: Vec<f64>,
    hi: Vec<f64>,
}

impl Mpnn {
    /// Builds the tree over n canonical rows of [`Space::coordinates`] numbers each.
    ///
    /// A leaf holds at most `leaf_rows` points, at least 1: fewer than m = `leaf_rows` + 1 in the paper's words. A leaf
    /// holds more only where no cut separates them, as they agree in every coordinate of positive weight.
    ///
    /// # Errors
    /// The rows are not canonical states of the space, two have the same id, or there are more than
    /// [`Points::MAX_POINTS`].
    pub fn new(space: Space, points: Points, leaf_rows: usize) -> Result<Self, PointsError> {
        points.check(&space)?;
        let axes = axes(&space);
        let leaf_rows = leaf_rows.max(1);
        let mut slots: Vec<u32> = (0..points.len() as u32).collect();
        let (lo, hi) = enclosing_box(&points, &slots);
        let mut nodes = Vec::new();
        // A stack of its own: points that crowd towards a corner make a tree thousands of levels deep.
        let mut open = Vec::new();
        if !points.is_empty() {
            open.push((0..points.len(), lo.clone(), hi.clone(), None));
        }
        while let Some((rows, lo, hi, parent)) = open.pop() {
            let index = nodes.len();
            if let Some(parent) = parent
                && let Node::Split { high, .. } = &mut nodes[parent]
            {
                *high = index as u32;
            }
            let own = &mut slots[rows.clone()];
            let split = (own.len() > leaf_rows)
                .then(|| sliding_midpoint(&axes, &points, own, &lo, &hi))
                .flatten();
            let Some((axis, cut, low_rows)) = split else {
                nodes.push(Node::Leaf {
                    start: rows.start as u32,
                    end: rows.end as u32,
                });
                continue;
            };
            let middle = rows.start + low_rows;
            nodes.push(Node::Split {
                axis: axis as u32,
                high: 0,
                cut,
            });
            let (mut high_lo, mut low_hi) = (lo.clone(), hi.clone());
            (high_lo[axis], low_hi[axis]) = (cut, cut);
            open.push((middle..rows.end, high_lo, hi, Some(index)));
            open.push((rows.start..middle, lo, low_hi, None));
        }
        let mut ordered = Points::with_capacity(points.coordinates(), points.len());
        for &slot in &slots {
            ordered.push_point(points.get(slot as usize));
        }
        Ok(Self {
            key_map: KeyMap::new(&space),
            space,
            axes,
            leaf_rows,
            points: ordered,
            nodes,
            lo,
            hi,
        })
    }

    /// Answers `search` for a canonical `state`.
    ///
    /// # Errors
    /// The state is not a canonical state of the space, a number of the search is out of its range, or its time passed.
    pub fn search(&self, state: &[f64], search: &Search<'_>) -> Result<Answer, SearchError> {
        search.check(&self.space, state)?;
        query::search(self, state, search)
    }

    /// The number of points.
    pub fn len(&self) -> usize {
        self.points.len()
    }

    /// True if there are none.
    pub fn is_empty(&self) -> bool {
        self.points.is_empty()
    }
}

fn axes(space: &Space) -> Vec<Axis> {
    let mut axes = Vec::with_capacity(space.coordinates());
    let mut unit_lengths = space.unit_lengths().into_iter().enumerate();
    for part in space.parts() {
        let own = unit_lengths.by_ref().take(part.factor.coordinates());
        axes.extend(own.map(|(axis, unit_length)| Axis {
            factor: part.factor,
            first: match part.factor {
                Factor::SO3 => part.offset,
                Factor::RealVector(_) | Factor::SO2 { .. } => axis,
            },
            weight: part.weight,
            group: part.group,
            unit_length,
        }));
    }
    axes
}

/// The lower and the upper ends of the smallest box around some points.
fn enclosing_box(points: &Points, slots: &[u32]) -> (Vec<f64>, Vec<f64>) {
    let rows = slots.iter().map(|&slot| points.row(slot as usize));
    around_rows(points.coordinates(), rows)
}

/// Splits the points of a cell: reorders `slots`, and returns the axis, the cut and the number of points below it, none
/// if no cut separates the points. Sides are measured in the metric, and a side in which all points agree is not cut.
fn sliding_midpoint(
    axes: &[Axis],
    points: &Points,
    slots: &mut [u32],
    lo: &[f64],
    hi: &[f64],
) -> Option<(usize, f64, usize)> {
    let (least, greatest) = enclosing_box(points, slots);
    let side = |axis: usize| axes[axis].unit_length * (hi[axis] - lo[axis]);
    let spread = |axis: usize| axes[axis].unit_length * (greatest[axis] - least[axis]);
    let can_split = |axis: &usize| axes[*axis].unit_length > 0.0 && least[*axis] < greatest[*axis];
    let candidates = || (0..axes.len()).filter(can_split);
    let longest = candidates().map(side).fold(0.0, f64::max) * (1.0 - SIDE_TOLERANCE);
    let axis = candidates()
        .filter(|&axis| side(axis) >= longest)
        .max_by(|&a, &b| spread(a).total_cmp(&spread(b)))?;

    let cut = f64::midpoint(lo[axis], hi[axis]).clamp(least[axis], greatest[axis]);
    let mut low_rows = 0;
    for at in 0..slots.len() {
        let x = points.row(slots[at] as usize)[axis];
        // A plane that slid up to the first point leaves that point below it.
        if x < cut || x == least[axis] {
            slots.swap(at, low_rows);
            low_rows += 1;
        }
    }
    Some((axis, cut, low_rows))
}
