//! The static kd-tree, built once over a table of points.
//!
//! The method is that of Yershova and LaValle ("Improving Motion Planning Algorithms by Efficient Nearest-Neighbor
//! Searching", IEEE Transactions on Robotics): the tree is built in the un-identified space, an interval for each
//! circle and R⁴ for each rotation. That opposite ends of the interval, or q and −q, are one state enters only in the
//! query, in the lower bound of the distance from a state to a box. The tree itself is not theirs; it is made for wide
//! registers:
//!
//! - A cut is at a median, rounded to full leaves; theirs is a sliding midpoint.
//! - A node has up to sixteen children, where theirs has two. The children's boxes are tight in every coordinate and
//!   lie side by side, so that one pass bounds them all (see [`kernel`](crate::kernel)).
//! - The bound of a box is computed from all of its coordinates; theirs is updated by the one factor that a cut
//!   touches.
//! - A leaf keeps its points coordinate by coordinate.
//!
//! A tree does not change after its build, and any number of threads may search it.

mod build;
mod query;
mod validate;

use std::sync::Arc;

use crate::{
    Answer, Kernels, Point, Points, PointsError, Search, SearchError, Space,
    blocks::Blocks,
    boxes::Boxes,
    kernel::KeyMap,
    lanes::{BLOCK_ROWS, Isa, Task},
    quantize::QuantizedRows,
    scan_policy::ScanPolicy,
    traversal::Traversal,
};
pub(crate) use query::TreeSearch;
pub use validate::TreeReport;

/// The children of a node: `count` consecutive nodes or, at the bottom, leaves.
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
    key_map: KeyMap,
    /// Ids, tags and revisions in the order of the leaves, without rows.
    labels: Points,
    /// The number of points in every leaf but the last.
    leaf_rows: usize,
    /// The number of nodes between the root, included, and any leaf; 0 without points.
    height: u32,
    /// The root first.
    nodes: Vec<Node>,
    boxes: Boxes,
    /// The rows in the order of the leaves; each leaf begins a block.
    blocks: Blocks,
    quantized: Option<QuantizedRows>,
    /// The newest revision of a state: a search for newer ones skips the tree.
    newest: u64,
    scan_policy: ScanPolicy,
}

impl KdTree {
    /// Builds the tree over canonical rows, in O(d · n · log n), with leaves of `leaf_rows` points.
    ///
    /// # Errors
    /// The rows are not canonical states of the space, two have the same id, or there are more than
    /// [`Points::MAX_POINTS`].
    pub fn new(space: Space, points: Points, leaf_rows: usize) -> Result<Self, PointsError> {
        points.check(&space)?;
        Ok(Self::build(Arc::new(space), &points, leaf_rows))
    }

    /// Answers `search` for a canonical `state`.
    ///
    /// # Errors
    /// The state is not a canonical state of the space, a number of the search is out of its range, or its time passed.
    pub fn search(&self, state: &[f64], search: &Search<'_>) -> Result<Answer, SearchError> {
        self.search_with(&Kernels::default(), state, search)
    }

    /// Acts like [`KdTree::search`], with these kernels.
    ///
    /// # Errors
    /// The errors of [`KdTree::search`].
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
        Point {
            row: self.row(slot).collect(),
            ..self.labels.get(slot).to_point()
        }
    }

    /// Appends a copy of the point in `slot` to `points`.
    pub(crate) fn copy_to(&self, slot: usize, points: &mut Points) {
        points.push_numbers(self.labels.get(slot), self.row(slot));
    }

    fn row(&self, slot: usize) -> impl Iterator<Item = f64> {
        self.blocks.row(self.place(slot))
    }

    /// The place in the blocks of the row in `slot`.
    fn place(&self, slot: usize) -> usize {
        let (leaf, place) = (slot / self.leaf_rows, slot % self.leaf_rows);
        leaf * self.leaf_rows.next_multiple_of(BLOCK_ROWS) + place
    }

    /// Copies of all points, in the order of the leaves.
    pub fn iter(&self) -> impl ExactSizeIterator<Item = Point> {
        (0..self.len()).map(|slot| self.get(slot))
    }

    /// The ids, by slot.
    pub(crate) fn ids(&self) -> &[u64] {
        self.labels.ids()
    }

    /// The number of points.
    pub fn len(&self) -> usize {
        self.labels.len()
    }

    /// True if the tree has no points.
    pub fn is_empty(&self) -> bool {
        self.labels.is_empty()
    }

    /// The bytes that the tree holds.
    pub(crate) fn memory_bytes(&self) -> usize {
        self.labels.memory_bytes()
            + self.nodes.capacity() * size_of::<Node>()
            + self.boxes.memory_bytes()
            + self.blocks.memory_bytes()
            + self
                .quantized
                .as_ref()
                .map_or(0, QuantizedRows::memory_bytes)
    }
}

/// A search of one tree.
struct SearchTree<'a> {
    tree: &'a KdTree,
    state: &'a [f64],
    search: &'a Search<'a>,
}

impl Task for SearchTree<'_> {
    type Output = Result<Answer, SearchError>;

    #[inline(always)]
    fn run<I: Isa>(self) -> Self::Output {
        let tree = self.tree;
        self.search.check(&tree.space, self.state)?;
        let mut traversal = Traversal::new(&tree.space, &tree.key_map, self.state, self.search);
        traversal.search::<I, _>(&mut TreeSearch::new(tree, |_| true));
        traversal.finish::<I>()
    }
}
