//! The query: the nearest children of a node first, all that cannot matter skipped by their bounds.

use super::KdTree;
use crate::{
    kernel::{BLOCK, CHILDREN},
    search::Walk,
};

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
        descent.node(0, self.height);
    }
}

impl<V: Fn(usize) -> bool> Descent<'_, '_, '_, V> {
    /// Visits the node at `index`, so many nodes above the leaves, itself one of them.
    fn node(&mut self, index: usize, height: u32) {
        let node = self.tree.nodes[index];
        let mut keys = [0.0; CHILDREN];
        let within = self.walk.bound_boxes(self.tree.boxes(index), &mut keys) & !(!0 << node.count);

        let mut order = [(0.0, 0); CHILDREN];
        let count = sort(within, &keys, &mut order);
        for &(key, child) in &order[..count] {
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
        let mut keys = [0.0; BLOCK];
        for (start, block) in slots.clone().step_by(BLOCK).zip(self.tree.blocks(leaf)) {
            let points = (slots.end - start).min(BLOCK);
            let within = self.walk.bound_points(block, &mut keys) & !(!0 << points);
            let mut order = [(0.0, 0); BLOCK];
            let count = sort(within, &keys, &mut order);
            for &(key, lane) in &order[..count] {
                let slot = start + lane;
                if !self.walk.reaches(key) {
                    break;
                }
                if (self.visible)(slot) {
                    self.walk
                        .measure_in_block(&self.tree.points, slot, block, lane, key);
                }
            }
        }
    }
}

/// Writes the lanes in `within` with their keys, the nearest first, and returns how many there are: what is near soon
/// makes the rest not worth a look.
#[inline(always)]
fn sort<const N: usize>(within: u32, keys: &[f64; N], order: &mut [(f64, usize); N]) -> usize {
    let mut count = 0;
    for lane in bits(within) {
        let mut at = count;
        while at > 0 && order[at - 1].0 > keys[lane] {
            order[at] = order[at - 1];
            at -= 1;
        }
        order[at] = (keys[lane], lane);
        count += 1;
    }
    count
}

/// The places of the bits that are set, from the lowest.
fn bits(mut mask: u32) -> impl Iterator<Item = usize> {
    std::iter::from_fn(move || {
        let place = mask.trailing_zeros() as usize;
        (mask != 0).then(|| {
            mask &= mask - 1;
            place
        })
    })
}
