//! The query: the nearest children of a node first, all that cannot matter skipped by their bounds.

use super::KdTree;
use crate::{
    kernel::{BLOCK, prefetch},
    search::Walk,
};

/// What of a tree stays in a cache near the processor. Larger ones gain a tenth from asking ahead (at a million points
/// of R3 and R3*SO3), smaller ones lose some hundredths.
const NEAR_BYTES: usize = 4 << 20;

/// A search that has found no more neighbours should have reached but a part of a tree.
const FEW: usize = 100;

struct Descent<'t, 'w, 'a, V> {
    tree: &'t KdTree,
    walk: &'w mut Walk<'a>,
    /// Whether the point in a slot takes part.
    visible: V,
    /// Whether the next leaf is asked for while one is read.
    fetches: bool,
}

impl KdTree {
    /// Shows `walk` every visible point that can matter to it.
    pub(crate) fn visit(&self, walk: &mut Walk<'_>, visible: impl Fn(usize) -> bool) {
        if self.is_empty()
            || (walk.since_revision() > 0 && self.max_revision <= walk.since_revision())
        {
            return;
        }
        let mut descent = Descent {
            tree: self,
            walk,
            visible,
            fetches: self.blocks.memory_bytes() > NEAR_BYTES,
        };
        let plain = descent.walk.is_plain() && self.height > 2;
        if plain && self.reach.is_far() {
            (0..self.leaves()).for_each(|leaf| descent.leaf(leaf));
            return;
        }
        let entered = descent.walk.leaves_entered();
        descent.node(0, self.height);
        // Who finds many points must have looked at many.
        if plain && walk.found() <= FEW {
            let reached = walk.leaves_entered() - entered;
            self.reach.report(reached, self.leaves());
        }
    }
}

impl<V: Fn(usize) -> bool> Descent<'_, '_, '_, V> {
    /// Visits the node at `index`, so many nodes above the leaves, itself one of them.
    fn node(&mut self, index: usize, height: u32) {
        let node = self.tree.nodes[index];
        let first = node.first as usize;
        let boxes = self.tree.boxes(index);
        let mut children = self.walk.order(boxes, node.count as usize);
        let mut next = children.next();
        while let Some((key, child)) = next {
            next = children.next();
            if self.walk.skips(key) {
                continue;
            }
            if height > 1 {
                self.node(first + child, height - 1);
                continue;
            }
            if let Some((_, after)) = next
                && self.fetches
            {
                prefetch(self.tree.leaf_blocks(first + after).next().unwrap_or(&[]));
            }
            self.leaf(first + child);
        }
    }

    fn leaf(&mut self, leaf: usize) {
        if !self.walk.enters_leaf() {
            return;
        }
        let slots = self.tree.slots(leaf);
        for (start, block) in slots
            .clone()
            .step_by(BLOCK)
            .zip(self.tree.leaf_blocks(leaf))
        {
            let lanes = (slots.end - start).min(BLOCK);
            let labels = &self.tree.labels;
            self.walk
                .scan(block, lanes, labels, |lane| start + lane, &self.visible);
        }
    }
}
