//! The bounding boxes of the children of a node, side by side, coordinate by coordinate, in the form that the kernels
//! read.

use crate::{aligned::AlignedNumbers, lanes::MAX_CHILDREN};

/// The boxes of the children of some nodes. A node has, for each coordinate, the lower ends of [`MAX_CHILDREN`] boxes
/// and then their upper ends.
#[derive(Clone, Debug)]
pub(crate) struct Boxes {
    width: usize,
    ends: AlignedNumbers,
}

impl Boxes {
    /// The boxes of `nodes` nodes without children, in a space of `width` coordinates.
    pub(crate) fn new(width: usize, nodes: usize) -> Self {
        let len = nodes * width * 2 * MAX_CHILDREN;
        let mut ends = AlignedNumbers::with_capacity(len);
        ends.add_zeros(len);
        Self { width, ends }
    }

    /// Appends the boxes of `nodes` nodes without children.
    pub(crate) fn add_nodes(&mut self, nodes: usize) {
        self.ends.add_zeros(nodes * self.node_len());
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

    /// The ends of the smallest box around the first `count` children, in a coordinate.
    pub(crate) fn around_children(&self, node: usize, count: usize, axis: usize) -> (f64, f64) {
        let ends = &self.node(node)[axis * 2 * MAX_CHILDREN..][..2 * MAX_CHILDREN];
        let (lo, _) = extent(&ends[..count]);
        let (_, hi) = extent(&ends[MAX_CHILDREN..][..count]);
        (lo, hi)
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
            axis[child] = least(axis[child], &x);
            axis[MAX_CHILDREN + child] = greatest(axis[MAX_CHILDREN + child], &x);
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
        self.ends.memory_bytes()
    }
}

/// The least and the greatest of some numbers.
pub(crate) fn extent(numbers: &[f64]) -> (f64, f64) {
    let (fours, rest) = numbers.as_chunks::<4>();
    let (mut lo, mut hi) = ([f64::INFINITY; 4], [f64::NEG_INFINITY; 4]);
    for four in fours {
        widen(&mut lo, &mut hi, four);
    }
    let lo = lo.iter().chain(rest).fold(f64::INFINITY, least);
    let hi = hi.iter().chain(rest).fold(f64::NEG_INFINITY, greatest);
    (lo, hi)
}

/// The lower and the upper ends, in each of `width` coordinates, of the smallest box around some rows. (A build
/// computes many. Pairs of ends would keep the compiler from comparing several coordinates at once.)
pub(crate) fn around_rows<'a>(
    width: usize,
    rows: impl Iterator<Item = &'a [f64]>,
) -> (Vec<f64>, Vec<f64>) {
    let (mut lo, mut hi) = (vec![f64::INFINITY; width], vec![f64::NEG_INFINITY; width]);
    for row in rows {
        widen(&mut lo, &mut hi, row);
    }
    (lo, hi)
}

/// Widens intervals to contain their numbers.
#[inline(always)]
fn widen(lo: &mut [f64], hi: &mut [f64], numbers: &[f64]) {
    for ((lo, hi), x) in lo.iter_mut().zip(hi).zip(numbers) {
        (*lo, *hi) = (least(*lo, x), greatest(*hi, x));
    }
}

// (Not `min` and `max` of `f64`, which take three instructions instead of one because of NaN, which no row has.)
#[inline(always)]
fn least(a: f64, b: &f64) -> f64 {
    if *b < a { *b } else { a }
}

#[inline(always)]
fn greatest(a: f64, b: &f64) -> f64 {
    if *b > a { *b } else { a }
}
