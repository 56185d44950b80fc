//! The query: the nearest children of a node first, all that cannot matter skipped by their bounds.

use super::KdTree;
use crate::{
    kernel::{BLOCK, Set, prefetch},
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
        if plain && self.reach.is_far() {
            for leaf in 0..self.leaves() {
                self.visit_leaf::<S>(walk, leaf, &visible);
            }
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
                self.visit_leaf::<S>(walk, index, &visible);
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
                    Some(rounded) => prefetch(rounded.block(first)),
                    None => prefetch(self.blocks.block(first)),
                }
            }
        }
        if plain && walk.found_few() {
            let reached = walk.leaves_entered() - entered;
            self.reach.report(reached, self.leaves());
        }
    }

    #[inline(always)]
    fn visit_leaf<'a, S: Set>(
        &'a self,
        walk: &mut Walk<'a>,
        leaf: usize,
        visible: &impl Fn(usize) -> bool,
    ) {
        if !walk.enters_leaf() {
            return;
        }
        let slots = self.slots(leaf);
        for (start, at) in slots.clone().step_by(BLOCK).zip(self.leaf_blocks(leaf)) {
            let lanes = (slots.end - start).min(BLOCK);
            if let Some(rounded) = &self.rounded
                && !walk.may_matter::<S>(rounded.block(at), lanes, rounded.error())
            {
                continue;
            }
            let block = self.blocks.block(at);
            walk.scan::<S>(block, lanes, &self.labels, |lane| start + lane, visible);
        }
    }
}
