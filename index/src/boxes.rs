//! The bounding boxes of the children of a node, side by side, coordinate by coordinate, in the form that the kernels
//! read.

use crate::kernel::MAX_CHILDREN;

/// The boxes of the children of some nodes. A node has, for each coordinate, the lower ends of [`MAX_CHILDREN`] boxes
/// and then their upper ends.
#[derive(Clone, Debug)]
pub(crate) struct Boxes {
    width: usize,
    ends: Vec<f64>,
}

impl Boxes {
    /// The boxes of `nodes` nodes without children, in a space of `width` coordinates.
    pub(crate) fn new(width: usize, nodes: usize) -> Self {
        Self {
            width,
            ends: vec![0.0; nodes * width * 2 * MAX_CHILDREN],
        }
    }

    /// Appends the boxes of `nodes` nodes without children.
    pub(crate) fn add_nodes(&mut self, nodes: usize) {
        let len = self.ends.len() + nodes * self.node_len();
        self.ends.resize(len, 0.0);
    }

    fn node_len(&self) -> usize {
        self.width * 2 * MAX_CHILDREN
    }

    /// The boxes of a node's children.
    #[inline(always)]
    pub(crate) fn node(&self, node: usize) -> &[f64] {
        let len = self.width * 2 * MAX_CHILDREN;
        &self.ends[node * len..][..len]
    }

    /// The lower and upper end of a child's box in each coordinate.
    pub(crate) fn child(&self, node: usize, child: usize) -> impl Iterator<Item = (f64, f64)> {
        let axes = self.node(node).chunks_exact(2 * MAX_CHILDREN);
        axes.map(move |ends| (ends[child], ends[MAX_CHILDREN + child]))
    }

    /// The ends of the smallest box around the first `count` children, in each coordinate.
    pub(crate) fn around_children(
        &self,
        node: usize,
        count: usize,
    ) -> impl Iterator<Item = (f64, f64)> {
        let axes = self.node(node).chunks_exact(2 * MAX_CHILDREN);
        axes.map(move |ends| {
            let (lo, _) = extent(ends[..count].iter().copied());
            let (_, hi) = extent(ends[MAX_CHILDREN..][..count].iter().copied());
            (lo, hi)
        })
    }

    /// Sets the box of a child.
    pub(crate) fn set(
        &mut self,
        node: usize,
        child: usize,
        ends: impl Iterator<Item = (f64, f64)>,
    ) {
        for (axis, (lo, hi)) in self.axes_mut(node).zip(ends) {
            axis[child] = lo;
            axis[MAX_CHILDREN + child] = hi;
        }
    }

    /// Widens the box of a child to contain a row.
    pub(crate) fn widen(&mut self, node: usize, child: usize, row: &[f64]) {
        for (axis, &x) in self.axes_mut(node).zip(row) {
            axis[child] = axis[child].min(x);
            axis[MAX_CHILDREN + child] = axis[MAX_CHILDREN + child].max(x);
        }
    }

    /// True if the box of a child contains a row.
    pub(crate) fn contains(&self, node: usize, child: usize, row: &[f64]) -> bool {
        let mut ends = self.child(node, child).zip(row);
        ends.all(|((lo, hi), x)| (lo..=hi).contains(x))
    }

    fn axes_mut(&mut self, node: usize) -> impl Iterator<Item = &mut [f64]> {
        let len = self.node_len();
        self.ends[node * len..][..len].chunks_exact_mut(2 * MAX_CHILDREN)
    }

    /// Frees the unused capacity.
    pub(crate) fn shrink_to_fit(&mut self) {
        self.ends.shrink_to_fit();
    }

    /// The bytes that the boxes hold.
    pub(crate) fn memory_bytes(&self) -> usize {
        8 * self.ends.capacity()
    }
}

/// The least and the greatest of some numbers.
pub(crate) fn extent(numbers: impl Iterator<Item = f64>) -> (f64, f64) {
    numbers.fold((f64::INFINITY, f64::NEG_INFINITY), |(lo, hi), x| {
        (lo.min(x), hi.max(x))
    })
}

/// The ends, in each of `width` coordinates, of the smallest box around some rows.
pub(crate) fn around_rows<'a>(
    width: usize,
    rows: impl Iterator<Item = &'a [f64]>,
) -> Vec<(f64, f64)> {
    let mut ends = vec![(f64::INFINITY, f64::NEG_INFINITY); width];
    for row in rows {
        for ((lo, hi), &x) in ends.iter_mut().zip(row) {
            (*lo, *hi) = (lo.min(x), hi.max(x));
        }
    }
    ends
}
