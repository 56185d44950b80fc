//! The invariants of a tree.

use super::KdTree;
use crate::{
    lanes::{BLOCK_ROWS, MAX_CHILDREN},
    quantize::CODE_ROWS,
};

/// The result of [`KdTree::validate`]: a test can assert that its tree was deep enough and scanned.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TreeReport {
    /// The number of nodes between the root, included, and a leaf.
    pub height: usize,
    /// The number of searches that read all leaves in order instead of descending.
    pub scans: usize,
}

impl KdTree {
    /// Checks that the leaves are reached in order, each once and equally deep, and that every point is within the
    /// boxes above it.
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
                "{} nodes are unreachable",
                self.nodes.len() - check.nodes
            ));
        }
        if check.next_leaf != self.leaves() {
            return Err(format!(
                "{} leaves are unreachable",
                self.leaves() - check.next_leaf
            ));
        }
        if let Some(newer) = self.labels.iter().find(|p| p.revision > self.newest) {
            return Err(format!("point {} is newer than its tree", newer.id));
        }
        Ok(TreeReport {
            height: self.height as usize,
            scans: self.scan_policy.scans(),
        })
    }
}

struct Check<'a> {
    tree: &'a KdTree,
    /// The number of nodes reached so far, the root included.
    nodes: usize,
    next_leaf: usize,
}

impl Check<'_> {
    /// Checks the subtree of a node; `path` has the nodes above it, each with the child that leads here.
    fn subtree(
        &mut self,
        index: usize,
        height: u32,
        path: &mut Vec<(usize, usize)>,
    ) -> Result<(), String> {
        let node = self.tree.nodes[index];
        let (first, count) = (node.first as usize, node.count as usize);
        if !(1..=MAX_CHILDREN).contains(&count) {
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
            if let Some(rows) = &self.tree.quantized {
                let place = self.tree.place(slot);
                let (codes, first) = rows.codes(place / BLOCK_ROWS);
                let codes = codes[first + place % BLOCK_ROWS..].iter();
                let row = point.row.iter().enumerate();
                let row = row.map(|(axis, &x)| rows.quantizer().code(axis, x));
                if !codes.step_by(CODE_ROWS).copied().eq(row) {
                    return Err(format!("point {} has wrong codes", point.id));
                }
            }
            let is_outside = |&&(node, child): &&(usize, usize)| {
                !self.tree.boxes.contains(node, child, &point.row)
            };
            if let Some((node, child)) = path.iter().find(is_outside) {
                return Err(format!(
                    "point {} is outside child {child} of node {node}",
                    point.id
                ));
            }
        }
        Ok(())
    }
}
