//! The static kd-tree, built once over a table of points.
//!
//! The method is that of Yershova and LaValle ("Improving Motion Planning Algorithms by Efficient Nearest-Neighbor
//! Searching", IEEE Transactions on Robotics): the tree is built in the un-identified space, an interval for each circle
//! and R⁴ for each rotation. That opposite ends of the interval, or q and −q, are one state enters only in the query, in
//! the lower bound of the distance from a state to a box. The tree itself is not theirs; it is made for wide registers:
//!
//! - A cut is at a median, rounded to full leaves; theirs is a sliding midpoint.
//! - A node has up to sixteen children, where theirs has two. The children's boxes are tight in every coordinate and lie
//!   side by side, so that one pass bounds them all (see [`kernel`](crate::kernel)).
//! - The bound of a box is computed from all of its coordinates; theirs is updated by the one factor that a cut touches.
//! - A leaf keeps its points coordinate by coordinate.
//!
//! Nothing here changes after the build: a tree may be searched from any number of threads.

mod build;
mod query;
mod reach;
mod rounded;
mod validate;

use std::sync::Arc;

use crate::{
    Answer, Kernels, Point, Points, PointsError, Search, SearchError, Space,
    blocks::Blocks,
    kernel::{BLOCK, CHILDREN, Scale, Set, Task},
    search::Walk,
};
pub(crate) use build::scales;
pub(crate) use reach::Reach;
use rounded::Rounded;
pub use validate::TreeReport;

/// Where a node's children are: that many, one after the other, among the nodes or, at the bottom, among the leaves.
#[derive(Clone, Copy, Debug)]
struct Node {
    first: u32,
    count: u32,
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
/// let tree = KdTree::new(space, points, 8)?;
/// let nearest = tree.search(&[0.0, 0.0, -3.0], &Search::nearest_k(1))?;
/// assert_eq!(nearest.neighbors[0].id, 2);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Clone, Debug)]
pub struct KdTree {
    space: Arc<Space>,
    scale: Scale,
    /// Ids, tags and revisions in the order of the leaves, without rows.
    labels: Points,
    /// Every leaf but the last has as many.
    leaf_rows: usize,
    /// Nodes on the way from the root to a leaf, the same for all leaves; 0 without points.
    height: u32,
    /// The root first.
    nodes: Vec<Node>,
    /// For each node and coordinate the lower ends of its children's boxes, then the upper ends.
    boxes: Vec<f64>,
    /// The rows of each leaf, which begins a block.
    blocks: Blocks,
    rounded: Option<Rounded>,
    /// The newest state of the tree, so that a search for newer ones can skip it whole.
    max_revision: u64,
    reach: Reach,
}

impl KdTree {
    /// Most points of a tree: its slots are 32 bits wide.
    pub const MAX_POINTS: usize = u32::MAX as usize;

    /// Builds the tree over canonical rows, in O(d · n · log n), with leaves of `leaf_rows` points.
    ///
    /// # Errors
    /// The rows are not canonical states of the space, two have the same id, or there are more than
    /// [`KdTree::MAX_POINTS`].
    pub fn new(space: Space, points: Points, leaf_rows: usize) -> Result<Self, PointsError> {
        points.check(&space)?;
        Ok(Self::build(Arc::new(space), points, leaf_rows))
    }

    /// Answers `search` for a canonical `state`.
    ///
    /// # Errors
    /// The state is not a canonical state of the space, or a number of the search is out of its range.
    pub fn search(&self, state: &[f64], search: &Search<'_>) -> Result<Answer, SearchError> {
        self.search_with(&Kernels::default(), state, search)
    }

    /// As [`KdTree::search`], with these kernels.
    ///
    /// # Errors
    /// As [`KdTree::search`].
    pub fn search_with(
        &self,
        kernels: &Kernels,
        state: &[f64],
        search: &Search<'_>,
    ) -> Result<Answer, SearchError> {
        kernels.run(SearchTree {
            tree: self,
            state,
            search,
        })
    }

    /// A copy of the point in `slot`, in the order of the leaves.
    pub fn get(&self, slot: usize) -> Point {
        let label = self.labels.get(slot);
        Point {
            id: label.id,
            tag: label.tag,
            revision: label.revision,
            row: self.row(slot).collect(),
        }
    }

    /// Appends a copy of the point in `slot` to `points`.
    pub(crate) fn copy_to(&self, slot: usize, points: &mut Points) {
        let label = self.labels.get(slot);
        points.push_numbers(label.id, label.tag, label.revision, self.row(slot));
    }

    /// The row in `slot`.
    fn row(&self, slot: usize) -> impl Iterator<Item = f64> {
        self.blocks.row(self.place(slot))
    }

    /// The place in the blocks of what stands in `slot`.
    fn place(&self, slot: usize) -> usize {
        let (leaf, place) = (slot / self.leaf_rows, slot % self.leaf_rows);
        leaf * self.leaf_rows.next_multiple_of(BLOCK) + place
    }

    /// Copies of all points, in the order of the leaves.
    pub fn iter(&self) -> impl ExactSizeIterator<Item = Point> {
        (0..self.len()).map(|slot| self.get(slot))
    }

    /// The ids, by slot.
    pub(crate) fn ids(&self) -> &[u64] {
        self.labels.ids()
    }

    /// How many points there are.
    pub fn len(&self) -> usize {
        self.labels.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.labels.is_empty()
    }

    /// The bytes the tree holds.
    pub(crate) fn memory_bytes(&self) -> usize {
        self.labels.memory_bytes()
            + self.nodes.capacity() * size_of::<Node>()
            + 8 * self.boxes.capacity()
            + self.blocks.memory_bytes()
            + self.rounded.as_ref().map_or(0, Rounded::memory_bytes)
    }

    /// How many leaves there are.
    fn leaves(&self) -> usize {
        self.len().div_ceil(self.leaf_rows)
    }

    /// The slots of a leaf's points.
    fn slots(&self, leaf: usize) -> std::ops::Range<usize> {
        let start = leaf * self.leaf_rows;
        start..(start + self.leaf_rows).min(self.len())
    }

    /// The boxes of a node's children, as the kernels take them.
    fn boxes(&self, node: usize) -> &[f64] {
        let width = self.space.coordinates() * 2 * CHILDREN;
        &self.boxes[node * width..][..width]
    }

    /// The places of a leaf's blocks: each of `BLOCK` points, the last of what is left.
    fn leaf_blocks(&self, leaf: usize) -> std::ops::Range<usize> {
        let first = self.place(leaf * self.leaf_rows) / BLOCK;
        first..first + self.slots(leaf).len().div_ceil(BLOCK)
    }
}

/// The search of a tree, as a whole.
struct SearchTree<'a> {
    tree: &'a KdTree,
    state: &'a [f64],
    search: &'a Search<'a>,
}

impl Task for SearchTree<'_> {
    type Output = Result<Answer, SearchError>;

    #[inline(always)]
    fn run<S: Set>(self) -> Result<Answer, SearchError> {
        self.search.check(&self.tree.space, self.state)?;
        let mut walk = Walk::new(&self.tree.space, &self.tree.scale, self.state, self.search);
        self.tree.visit::<S>(&mut walk, |_| true);
        Ok(walk.finish())
    }
}
