//! The invariants of a growing tree.

use super::{
    GrowingTree,
    branch::{Branch, Cell},
    leaf::{Label, Leaf},
};
use crate::{TreeReport, forest::tombstones::LATEST};

impl GrowingTree {
    /// Checks that every living point is in the one leaf that its row leads to, within all boxes above it, that all
    /// leaves are equally deep, and that ids and counts agree.
    ///
    /// # Errors
    /// The first invariant found broken.
    pub(in super::super) fn validate(&self) -> Result<TreeReport, String> {
        let mut held = vec![false; self.rows()];
        let mut branches = Vec::new();
        self.check_cell(&self.root, &mut branches, &mut held)?;
        let is_visible = |slot: usize| self.is_visible(slot, LATEST);
        if let Some(slot) = (0..held.len()).find(|&slot| !held[slot] && is_visible(slot)) {
            return Err(format!("slot {slot} is in no leaf"));
        }
        let alive: Vec<usize> = (0..self.rows()).filter(|&slot| is_visible(slot)).collect();
        for &slot in &alive {
            let id = self.get(slot).id;
            if self.find(id, LATEST) != Some(slot) {
                return Err(format!("id {id} leads to another point"));
            }
        }
        let points = self.points_after(None, LATEST);
        let ids: Vec<u64> = points.map(|point| point.id).collect();
        if !ids.is_sorted_by(|a, b| a < b) {
            return Err("ids are not in order".into());
        }
        let alive = alive.len();
        if ids.len() != alive || alive + self.dead() != self.rows() {
            return Err(format!("{alive} points of {} are alive", self.rows()));
        }
        Ok(TreeReport {
            height: self.height,
            scans: self.scan_policy.scans(),
        })
    }

    /// Checks a subtree; `branches` has the nodes above it, each with the child that leads here.
    fn check_cell<'a>(
        &'a self,
        cell: &'a Cell,
        branches: &mut Vec<(&'a Branch, usize)>,
        held: &mut [bool],
    ) -> Result<(), String> {
        match cell {
            Cell::Leaf(leaf) if branches.len() == self.height => {
                self.check_leaf(leaf, branches, held)
            }
            Cell::Branch(branch) if !branch.children.is_empty() => {
                for (child, cell) in branch.children.iter().enumerate() {
                    branches.push((branch, child));
                    self.check_cell(cell, branches, held)?;
                    branches.pop();
                }
                Ok(())
            }
            _ => Err("leaves are not equally deep".into()),
        }
    }

    fn check_leaf(
        &self,
        leaf: &Leaf,
        branches: &[(&Branch, usize)],
        held: &mut [bool],
    ) -> Result<(), String> {
        if leaf.rows() == 0 && self.rows() > 0 {
            return Err("a leaf is empty".into());
        }
        for block in leaf.blocks() {
            for lane in 0..block.lanes {
                let Label { id, slot } = block.label(lane);
                let slot = slot as usize;
                if held.get(slot) != Some(&false) {
                    return Err(format!("slot {slot} stands in two leaves"));
                }
                held[slot] = true;
                let point = self.get(slot);
                let row = block.row(lane);
                if point.id != id || !row.eq(point.row.iter().copied()) {
                    return Err(format!("point {} differs in its leaf", point.id));
                }
                let leads_here = |&(branch, child): &(&Branch, usize)| {
                    branch.route(&point.row) == child
                        && branch.newest[child] >= point.revision
                        && branch.boxes.contains(0, child, &point.row)
                };
                if !branches.iter().all(leads_here) || self.newest < point.revision {
                    return Err(format!("point {id} is not where its row leads"));
                }
            }
        }
        Ok(())
    }
}
