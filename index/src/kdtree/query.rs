//! The query: the nearest children of a node first, all that cannot matter skipped by their bounds.

use super::{KdTree, rounded::PAIR};
use crate::{
    kernel::{Asked, BLOCK, Set, prefetch},
    search::{Ahead, Walk},
};

/// Where a cell is: a node or, at height 0, a leaf.
#[derive(Clone, Copy, Debug)]
struct Place {
    index: u32,
    height: u32,
}

impl Place {
    /// The place of a node's `child`, given that of its first.
    #[inline(always)]
    fn child((first, child): (Self, usize)) -> Self {
        Self {
            index: first.index + child as u32,
            ..first
        }
    }
}

/// What of a tree stays in a cache near the processor. Larger ones gain a tenth from asking ahead (at a million points
/// of R3 and R3*SO3), smaller ones lose some hundredths.
const NEAR_BYTES: usize = 4 << 20;

/// The bits of a block.
const ONE_BLOCK: u32 = !(!0 << BLOCK);

impl KdTree {
    /// Shows `walk` every visible point that can matter to it.
    #[inline(always)]
    pub(crate) fn visit<'a, S: Set>(
        &'a self,
        walk: &mut Walk<'a>,
        visible: impl Fn(usize) -> bool,
    ) {
        if self.is_empty()
            || (walk.since_revision() > 0 && self.max_revision <= walk.since_revision())
        {
            return;
        }
        // (What has no more than a node of leaves is read soon enough either way.)
        let plain = walk.is_plain() && self.height > 1;
        let mut asked = None;
        if plain && self.reach.is_far() {
            self.visit_all::<S>(walk, &mut asked, &visible);
            return;
        }
        let entered = walk.leaves_entered();
        let fetches = self.blocks.memory_bytes() > NEAR_BYTES;
        let root = Place {
            index: 0,
            height: self.height,
        };
        let (mut ahead, mut next) = (Ahead::new(), Some(root));
        while let Some(Place { index, height }) = next {
            let index = index as usize;
            if height == 0 {
                self.visit_leaf::<S>(walk, &mut asked, index, &visible);
            } else {
                let node = self.nodes[index];
                let (boxes, lanes) = (self.boxes(index), !(!0 << node.count));
                let first = Place {
                    index: node.first,
                    height: height - 1,
                };
                walk.open::<S, _>(&mut ahead, boxes, lanes, first);
            }
            next = walk.next::<S, _>(&mut ahead).map(Place::child);
            if fetches && let Some(Place { index, height: 0 }) = ahead.peek().map(Place::child) {
                let first = self.leaf_blocks(index as usize).start;
                match &self.rounded {
                    Some(rounded) => prefetch(rounded.codes(first).0),
                    None => prefetch(self.blocks.block(first)),
                }
            }
        }
        if plain && walk.found_few() {
            let reached = walk.leaves_entered() - entered;
            // (By measurement. Codes are read several times as fast as what they are of.)
            let worth = if self.rounded.is_some() { 3 } else { 2 };
            self.reach.report(worth * reached >= self.leaves());
        }
    }

    /// All leaves in the order of memory; by codes all blocks, two at once, each two counted as a leaf.
    #[inline(always)]
    fn visit_all<'a, S: Set>(
        &'a self,
        walk: &mut Walk<'a>,
        asked: &mut Option<Asked<'a>>,
        visible: &impl Fn(usize) -> bool,
    ) {
        let Some(rounded) = &self.rounded else {
            for leaf in 0..self.leaves() {
                self.visit_leaf::<S>(walk, asked, leaf, visible);
            }
            return;
        };
        for (at, codes) in rounded.blocks().enumerate() {
            if !walk.enters_leaf() {
                return;
            }
            let near = walk.may_matter::<S>(rounded.coding(), asked, codes);
            for half in 0..PAIR {
                if near >> (half * BLOCK) & ONE_BLOCK != 0 {
                    self.visit_block::<S>(walk, at * PAIR + half, visible);
                }
            }
        }
    }

    #[inline(always)]
    fn visit_leaf<'a, S: Set>(
        &'a self,
        walk: &mut Walk<'a>,
        asked: &mut Option<Asked<'a>>,
        leaf: usize,
        visible: &impl Fn(usize) -> bool,
    ) {
        if !walk.enters_leaf() {
            return;
        }
        for at in self.leaf_blocks(leaf) {
            if let Some(rounded) = &self.rounded {
                let (codes, first) = rounded.codes(at);
                let near = walk.may_matter::<S>(rounded.coding(), asked, codes);
                if near >> first & ONE_BLOCK == 0 {
                    continue;
                }
            }
            self.visit_block::<S>(walk, at, visible);
        }
    }

    #[inline(always)]
    fn visit_block<'a, S: Set>(
        &'a self,
        walk: &mut Walk<'a>,
        at: usize,
        visible: &impl Fn(usize) -> bool,
    ) {
        let blocks = self.leaf_rows.div_ceil(BLOCK);
        let slots = self.slots(at / blocks);
        let start = slots.start + at % blocks * BLOCK;
        let lanes = slots.end.saturating_sub(start).min(BLOCK);
        if lanes == 0 {
            // The end of the last leaf, or the other half of the last block of codes.
            return;
        }
        let block = self.blocks.block(at);
        walk.scan::<S>(block, lanes, &self.labels, |lane| start + lane, visible);
    }
}
