//! The search of a tree (see [`traversal`](crate::traversal)).

use std::ops::Range;

use super::KdTree;
use crate::{
    lanes::{BLOCK_ROWS, Isa, prefetch},
    quantize::{QuantizedQuery, ROW_BLOCKS},
    scan_policy::ScanPolicy,
    traversal::{Frontier, LEAVES_PER_CLOCK_READ, Traversal, Tree},
};

/// A node or, at height 0, a leaf.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Cell {
    index: u32,
    height: u32,
}

/// The size of a tree that stays in the cache. Prefetching makes searches of a larger tree faster, and those of a
/// smaller one slower.
const CACHED_BYTES: usize = 4 << 20;

/// The bits of a block of rows.
const BLOCK_MASK: u32 = !(!0 << BLOCK_ROWS);

/// One search of a tree, which finds the visible points.
pub(crate) struct TreeSearch<'a, V> {
    tree: &'a KdTree,
    is_visible: V,
    /// The query in the steps of the codes, prepared when a block of codes is first read.
    query: Option<QuantizedQuery<'a>>,
    prefetches: bool,
}

impl<'a, V: Fn(usize) -> bool> TreeSearch<'a, V> {
    #[inline(always)]
    pub(crate) fn new(tree: &'a KdTree, is_visible: V) -> Self {
        Self {
            tree,
            is_visible,
            query: None,
            prefetches: tree.blocks.memory_bytes() > CACHED_BYTES,
        }
    }

    #[inline(always)]
    fn scan_leaf<I: Isa>(&mut self, traversal: &mut Traversal<'a>, leaf: usize) {
        if !traversal.enter_leaf() {
            return;
        }
        for (nth, block) in self.tree.leaf_blocks(leaf).enumerate() {
            // All points of a large mutation are one leaf until a merge packs them, so a block counts as a leaf here.
            if (nth + 1).is_multiple_of(LEAVES_PER_CLOCK_READ) && !traversal.is_in_time() {
                return;
            }
            if let Some(rows) = &self.tree.quantized {
                let (codes, first) = rows.codes(block);
                let near = traversal.filter_codes::<I>(rows.quantizer(), &mut self.query, codes);
                if near >> first & BLOCK_MASK == 0 {
                    continue;
                }
            }
            self.scan_block::<I>(traversal, block);
        }
    }

    #[inline(always)]
    fn scan_block<I: Isa>(&self, traversal: &mut Traversal<'a>, block: usize) {
        let tree = self.tree;
        let blocks = tree.leaf_rows.div_ceil(BLOCK_ROWS);
        let slots = tree.slots(block / blocks);
        let start = slots.start + block % blocks * BLOCK_ROWS;
        let lanes = slots.end.saturating_sub(start).min(BLOCK_ROWS);
        if lanes == 0 {
            // Beyond the end of the last leaf: a place that pads a block of codes.
            return;
        }
        let (rows, slot) = (tree.blocks.block(block), |lane| start + lane);
        traversal.scan_block::<I>(rows, lanes, &tree.labels, slot, &self.is_visible);
    }
}

impl<'a, V: Fn(usize) -> bool> Tree<'a> for TreeSearch<'a, V> {
    type Cell = Cell;
    /// The first of them.
    type Children = Cell;

    fn newest(&self) -> u64 {
        self.tree.newest
    }

    #[inline(always)]
    fn root(&self) -> Option<Cell> {
        let height = self.tree.height;
        (height > 0).then_some(Cell { index: 0, height })
    }

    #[inline(always)]
    fn child(&self, first: Cell, child: usize) -> Cell {
        Cell {
            index: first.index + child as u32,
            ..first
        }
    }

    #[inline(always)]
    fn visit<I: Isa>(
        &mut self,
        Cell { index, height }: Cell,
        traversal: &mut Traversal<'a>,
        frontier: &mut Frontier<Cell>,
    ) {
        let index = index as usize;
        if height == 0 {
            self.scan_leaf::<I>(traversal, index);
            return;
        }
        let node = self.tree.nodes[index];
        let first = Cell {
            index: node.first,
            height: height - 1,
        };
        let lanes = !(!0 << node.count);
        traversal.expand::<I, _>(frontier, self.tree.boxes.node(index), lanes, first);
    }

    /// A block of codes counts as one leaf, and stands for two blocks of rows.
    #[inline(always)]
    fn scan<I: Isa>(&mut self, traversal: &mut Traversal<'a>) {
        let Some(rows) = &self.tree.quantized else {
            for leaf in 0..self.tree.leaves() {
                self.scan_leaf::<I>(traversal, leaf);
            }
            return;
        };
        for (at, codes) in rows.blocks().enumerate() {
            if !traversal.enter_leaf() {
                return;
            }
            let near = traversal.filter_codes::<I>(rows.quantizer(), &mut self.query, codes);
            for half in 0..ROW_BLOCKS {
                if near >> (half * BLOCK_ROWS) & BLOCK_MASK != 0 {
                    self.scan_block::<I>(traversal, at * ROW_BLOCKS + half);
                }
            }
        }
    }

    #[inline(always)]
    fn scan_policy(&self) -> Option<&'a ScanPolicy> {
        (self.tree.height > 1).then_some(&self.tree.scan_policy)
    }

    /// A scan costs less than a descent to half of the leaves, or to a third where the scan reads codes.
    fn scan_is_cheaper(&self, leaves: usize) -> bool {
        let gain = if self.tree.quantized.is_some() { 3 } else { 2 };
        gain * leaves >= self.tree.leaves()
    }

    #[inline(always)]
    fn prefetch(&self, frontier: &Frontier<Cell>) {
        if self.prefetches
            && let Some((first, child)) = frontier.peek()
            && first.height == 0
        {
            let leaf = self.child(first, child).index as usize;
            let block = self.tree.leaf_blocks(leaf).start;
            match &self.tree.quantized {
                Some(rows) => prefetch(rows.codes(block).0),
                None => prefetch(self.tree.blocks.block(block)),
            }
        }
    }
}

impl KdTree {
    /// The number of leaves.
    pub(super) fn leaves(&self) -> usize {
        self.len().div_ceil(self.leaf_rows)
    }

    /// The slots of a leaf's points.
    pub(super) fn slots(&self, leaf: usize) -> Range<usize> {
        let start = leaf * self.leaf_rows;
        start..(start + self.leaf_rows).min(self.len())
    }

    /// The blocks of a leaf, all of them full but the last.
    fn leaf_blocks(&self, leaf: usize) -> Range<usize> {
        let first = self.place(leaf * self.leaf_rows) / BLOCK_ROWS;
        first..first + self.slots(leaf).len().div_ceil(BLOCK_ROWS)
    }
}
