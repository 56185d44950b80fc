//! The invariants of a tree, for the tests that call this after every step.

use super::KdTree;
use crate::kernel::{BLOCK, CHILDREN, CODES};

/// What [`KdTree::validate`] found in a tree, so that a test can tell that it reached what it is about.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TreeReport {
    /// The number of nodes between the root, included, and a leaf.
    pub height: usize,
    /// The number of searches that read all leaves in order instead of descending.
    pub scans: usize,
}

impl KdTree {
    /// Checks that the leaves are reached in order, each once and equally deep, that every point lies in the boxes
    /// above it, and that the blocks hold the rows.
    ///
    /// # Errors
    /// The first invariant found broken.
    pub fn validate(&self) -> Result<TreeReport, String> {
        let mut check = Check {
            tree: self,
            nodes: 0,
            next_leaf: 0,
        };
        if self.height > 0 {
            check.nodes = 1;
            check.subtree(0, self.height, &mut Vec::new())?;
        }
        if check.nodes != self.nodes.len() {
            return Err(format!(
                "{} nodes are out of reach",
                self.nodes.len() - check.nodes
            ));
        }
        if check.next_leaf != self.leaves() {
            return Err(format!(
                "{} leaves are out of reach",
                self.leaves() - check.next_leaf
            ));
        }
        if let Some(newer) = self.labels.iter().find(|p| p.revision > self.max_revision) {
            return Err(format!("point {} is newer than its tree", newer.id));
        }
        Ok(TreeReport {
            height: self.height as usize,
            scans: self.reach.scans(),
        })
    }
}

struct Check<'a> {
    tree: &'a KdTree,
    /// How many nodes have a parent, or are the root.
    nodes: usize,
    next_leaf: usize,
}

impl Check<'_> {
    /// Checks the subtree of a node, which lies in the children at `path` of the nodes above it.
    fn subtree(
        &mut self,
        index: usize,
        height: u32,
        path: &mut Vec<(usize, usize)>,
    ) -> Result<(), String> {
        let node = self.tree.nodes[index];
        let (first, count) = (node.first as usize, node.count as usize);
        if !(1..=CHILDREN).contains(&count) {
            return Err(format!("node {index} has {count} children"));
        }
        if height > 1 {
            self.nodes += count;
        }
        for child in 0..count {
            path.push((index, child));
            if height > 1 {
                self.subtree(first + child, height - 1, path)?;
            } else {
                self.leaf(first + child, path)?;
            }
            path.pop();
        }
        Ok(())
    }

    fn leaf(&mut self, leaf: usize, path: &[(usize, usize)]) -> Result<(), String> {
        if leaf != self.next_leaf {
            return Err(format!(
                "leaf {leaf} stands where {} belongs",
                self.next_leaf
            ));
        }
        self.next_leaf += 1;
        for slot in self.tree.slots(leaf) {
            let point = self.tree.get(slot);
            if !self.tree.row(slot).eq(point.row.iter().copied()) {
                return Err(format!("point {} differs in its block", point.id));
            }
            if let Some(rounded) = &self.tree.rounded {
                let place = self.tree.place(slot);
                let (codes, first) = rounded.codes(place / BLOCK);
                let codes = codes[first + place % BLOCK..].iter();
                let row = point.row.iter().enumerate();
                let row = row.map(|(axis, &x)| rounded.coding().code(axis, x));
                if !codes.step_by(CODES).copied().eq(row) {
                    return Err(format!("point {} differs where it is rounded", point.id));
                }
            }
            for (axis, &x) in point.row.iter().enumerate() {
                for &(node, child) in path {
                    let ends = &self.tree.boxes(node)[axis * 2 * CHILDREN..];
                    if !(ends[child]..=ends[CHILDREN + child]).contains(&x) {
                        return Err(format!(
                            "point {} is outside node {node} in axis {axis}",
                            point.id
                        ));
                    }
                }
            }
        }
        Ok(())
    }
}
