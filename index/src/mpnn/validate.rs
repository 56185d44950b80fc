//! The invariants of the tree, for the tests.

use std::ops::Range;

use super::{Mpnn, Node, enclosing_box};

impl Mpnn {
    /// Checks that cells lie within their parents, that leaves hold each point once, within its cell, and that no leaf
    /// is larger than it has to be.
    ///
    /// # Errors
    /// The first invariant found broken.
    pub fn validate(&self) -> Result<(), String> {
        let (mut next_node, mut next_slot) = (0, 0);
        let mut open = Vec::new();
        if !self.is_empty() {
            open.push((0, self.lo.clone(), self.hi.clone()));
        }
        while let Some((index, lo, hi)) = open.pop() {
            if index != next_node {
                return Err(format!("node {index} stands where {next_node} belongs"));
            }
            next_node += 1;
            match self.nodes.get(index) {
                Some(&Node::Split { axis, high, cut }) => {
                    let axis = axis as usize;
                    if !(lo[axis]..=hi[axis]).contains(&cut) {
                        return Err(format!("node {index} is cut outside its cell"));
                    }
                    let (mut high_lo, mut low_hi) = (lo.clone(), hi.clone());
                    (high_lo[axis], low_hi[axis]) = (cut, cut);
                    open.push((high as usize, high_lo, hi));
                    open.push((index + 1, lo, low_hi));
                }
                Some(&Node::Leaf { start, end }) => {
                    if start as usize != next_slot || start >= end {
                        return Err(format!("leaf {index} begins at {start}, not {next_slot}"));
                    }
                    next_slot = end as usize;
                    self.validate_leaf(index, start..end, &lo, &hi)?;
                }
                None => return Err(format!("there is no node {index}")),
            }
        }
        if (next_node, next_slot) != (self.nodes.len(), self.len()) {
            return Err(format!("{next_node} nodes reach {next_slot} points"));
        }
        Ok(())
    }

    fn validate_leaf(
        &self,
        index: usize,
        slots: Range<u32>,
        lo: &[f64],
        hi: &[f64],
    ) -> Result<(), String> {
        let slots: Vec<u32> = slots.collect();
        let (least, greatest) = enclosing_box(&self.points, &slots);
        let is_outside = |axis: usize| least[axis] < lo[axis] || greatest[axis] > hi[axis];
        if let Some(axis) = (0..lo.len()).find(|&axis| is_outside(axis)) {
            return Err(format!("leaf {index} leaves its cell in axis {axis}"));
        }
        let can_split = |axis: usize| self.axes[axis].scale > 0.0 && least[axis] < greatest[axis];
        if slots.len() > self.leaf_rows && (0..lo.len()).any(can_split) {
            return Err(format!("leaf {index} holds {} points", slots.len()));
        }
        Ok(())
    }
}
