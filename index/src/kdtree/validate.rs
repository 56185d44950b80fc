//! The invariants of a tree, for the tests that call this after every step.

use super::{KdTree, Node, Split};

impl KdTree {
    /// Checks that the leaves partition the slots in order, that every point lies in its cell, and that the nodes lie
    /// in preorder.
    ///
    /// # Errors
    /// The first invariant found broken.
    pub fn validate(&self) -> Result<(), String> {
        let mut check = Check {
            tree: self,
            lo: self.lo.clone(),
            hi: self.hi.clone(),
            next_node: 0,
            next_slot: 0,
        };
        check.subtree(0, 0)?;
        if check.next_node != self.nodes.len() {
            return Err(format!(
                "{} nodes are out of reach",
                self.nodes.len() - check.next_node
            ));
        }
        if check.next_slot != self.len() {
            return Err(format!(
                "{} points are in no leaf",
                self.len() - check.next_slot
            ));
        }
        if let Some(newer) = self.points.iter().find(|p| p.revision > self.max_revision) {
            return Err(format!("point {} is newer than its tree", newer.id));
        }
        Ok(())
    }
}

struct Check<'a> {
    tree: &'a KdTree,
    lo: Vec<f64>,
    hi: Vec<f64>,
    next_node: usize,
    next_slot: usize,
}

impl Check<'_> {
    /// Checks the subtree of the node `depth` cuts below the root.
    fn subtree(&mut self, index: usize, depth: usize) -> Result<(), String> {
        if depth > self.tree.depth {
            return Err(format!("node {index} is deeper than the tree"));
        }
        if index != self.next_node {
            return Err(format!(
                "node {index} stands where {} belongs",
                self.next_node
            ));
        }
        self.next_node += 1;
        match self.tree.nodes[index] {
            Node::Leaf { start, end } => self.leaf(start as usize, end as usize),
            Node::Split(split) => {
                let Split {
                    left_max,
                    right_min,
                    ..
                } = split;
                let axis = split.axis as usize;
                let part = &self.tree.space.parts()[split.part as usize];
                if !(part.offset..part.offset + part.factor.coordinates()).contains(&axis) {
                    return Err(format!("node {index} cuts an axis of another factor"));
                }
                if left_max > right_min {
                    return Err(format!("the children of node {index} overlap"));
                }
                let hi = std::mem::replace(&mut self.hi[axis], left_max);
                self.subtree(index + 1, depth + 1)?;
                self.hi[axis] = hi;
                let lo = std::mem::replace(&mut self.lo[axis], right_min);
                self.subtree(split.right as usize, depth + 1)?;
                self.lo[axis] = lo;
                Ok(())
            }
        }
    }

    fn leaf(&mut self, start: usize, end: usize) -> Result<(), String> {
        if start != self.next_slot || end < start {
            return Err(format!(
                "leaf {start}..{end} should start at {}",
                self.next_slot
            ));
        }
        self.next_slot = end;
        for slot in start..end {
            let point = self.tree.points.get(slot);
            for (axis, &x) in point.row.iter().enumerate() {
                if !(self.lo[axis]..=self.hi[axis]).contains(&x) {
                    return Err(format!(
                        "point {} is outside its cell in axis {axis}",
                        point.id
                    ));
                }
            }
        }
        Ok(())
    }
}
