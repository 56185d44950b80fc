//! The query: the nearest children of a node first, all that cannot matter skipped by their bounds.

use super::KdTree;
use crate::{kernel::BLOCK, search::Walk};

/// A search that has found no more neighbours should have reached but a part of a tree.
const FEW: usize = 100;

struct Descent<'t, 'w, 'a, V> {
    tree: &'t KdTree,
    walk: &'w mut Walk<'a>,
    /// Whether the point in a slot takes part.
    visible: V,
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
        let children = self.walk.order(self.tree.boxes(index), node.count as usize);
        for (key, child) in children {
            if self.walk.skips(key) {
                continue;
            }
            let child = node.first as usize + child;
            if height > 1 {
                self.node(child, height - 1);
            } else {
                self.leaf(child);
            }
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
