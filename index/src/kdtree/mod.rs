//! The static kd-tree of Yershova and LaValle ("Improving Motion Planning Algorithms by Efficient Nearest-Neighbor
//! Searching", IEEE Transactions on Robotics), built once over a table of points.
//!
//! The tree lives in the un-identified space: an interval for each circle, R⁴ for each rotation. That opposite ends of
//! the interval, or q and −q, are one state enters only in the query, in the bound from a state to a cell (see
//! [`query`]). Nothing here changes after the build: a tree may be searched from any number of threads.

mod build;
mod query;
mod validate;

use std::sync::Arc;

use crate::{Answer, PointRef, Points, Search, Space, search::Walk};

/// A node. Nodes lie in preorder: the left child of node `i` is node `i + 1`.
#[derive(Clone, Copy, Debug)]
enum Node {
    /// Cuts a cell in two.
    Split(Split),
    /// The points in these slots.
    Leaf { start: u32, end: u32 },
}

/// A cut of a cell across one coordinate.
#[derive(Clone, Copy, Debug)]
struct Split {
    /// The coordinate ...
    axis: u16,
    /// ... and the factor of the space that it belongs to.
    part: u16,
    /// The right child.
    right: u32,
    /// The greatest coordinate on the left ...
    left_max: f64,
    /// ... and the least on the right: the cells end where their points do, not at the plane between.
    right_min: f64,
}

/// A static kd-tree over a table of points of one space.
///
/// ```
/// use wayfold_index::{KdTree, Points, Search, Space};
///
/// let space: Space = "R2*SO2".parse()?;
/// let mut points = Points::new(space.coordinates());
/// points.push(1, 0, 1, &[0.0, 0.0, 3.1]);
/// points.push(2, 0, 1, &[0.0, 0.0, -3.1]);
/// let tree = KdTree::new(space, points, 8);
/// let nearest = tree.search(&[0.0, 0.0, -3.0], &Search::nearest_k(1));
/// assert_eq!(nearest.neighbors[0].id, 2);
/// # Ok::<(), wayfold_index::SpaceError>(())
/// ```
#[derive(Clone, Debug)]
pub struct KdTree {
    space: Arc<Space>,
    /// In the order of the leaves.
    points: Points,
    nodes: Vec<Node>,
    /// The box around all points, coordinate by coordinate.
    lo: Vec<f64>,
    hi: Vec<f64>,
    /// The longest path from the root to a leaf, which bounds the rounding of an incremental bound.
    depth: usize,
    /// The newest state of the tree, so that a search for newer ones can skip it whole.
    max_revision: u64,
}

impl KdTree {
    /// Most points of a tree: its slots are 32 bits wide.
    pub const MAX_POINTS: usize = u32::MAX as usize;

    /// Builds the tree over canonical rows, in O(d · n · log n), with leaves of at most `leaf_rows` points (more only
    /// where points coincide).
    ///
    /// # Panics
    /// If the rows are of another width than the space's, or more than [`KdTree::MAX_POINTS`].
    pub fn new(space: Space, points: Points, leaf_rows: usize) -> Self {
        Self::build(Arc::new(space), points, leaf_rows)
    }

    /// Answers `search` for a canonical `state`.
    pub fn search(&self, state: &[f64], search: &Search<'_>) -> Answer {
        let mut walk = Walk::new(&self.space, state, search);
        self.visit(&mut walk, |_| true);
        walk.finish()
    }

    /// The points, in the order of the leaves.
    pub fn points(&self) -> &Points {
        &self.points
    }

    /// The point in `slot` of [`KdTree::points`].
    pub fn get(&self, slot: usize) -> PointRef<'_> {
        self.points.get(slot)
    }

    /// How many points there are.
    pub fn len(&self) -> usize {
        self.points.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.points.is_empty()
    }

    /// The bytes the tree holds.
    pub(crate) fn memory_bytes(&self) -> usize {
        self.points.memory_bytes()
            + self.nodes.capacity() * size_of::<Node>()
            + 8 * (self.lo.capacity() + self.hi.capacity())
    }
}
