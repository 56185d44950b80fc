//! The invariants of a growing tree, for the tests that call this after every step.

use super::{
    Growing,
    branch::{Branch, Cell},
    leaf::{Label, Leaf},
};
use crate::{TreeReport, forest::tombstones::HEAD, kernel::CHILDREN};

impl Growing {
    /// Checks that every living point lies in the one leaf that its row leads to, inside all boxes above it, that all
    /// leaves are equally deep, and that ids and counts agree.
    ///
    /// # Errors
    /// The first invariant found broken.
    pub(in super::super) fn validate(&self) -> Result<TreeReport, String> {
        let mut held = vec![false; self.rows()];
        let mut branches = Vec::new();
        self.check_cell(&self.root, &mut branches, &mut held)?;
        let seen = |slot: usize| self.sees(slot, HEAD);
        if let Some(slot) = (0..held.len()).find(|&slot| !held[slot] && seen(slot)) {
            return Err(format!("slot {slot} is in no leaf"));
        }
        let alive: Vec<usize> = (0..self.rows()).filter(|&slot| seen(slot)).collect();
        for &slot in &alive {
            let id = self.get(slot).id;
            if self.find(id, HEAD) != Some(slot) {
                return Err(format!("id {id} leads to another point"));
            }
        }
        let points = self.points_after(None, HEAD);
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
            scans: self.reach.scans(),
        })
    }

    /// Checks what lies below `branches`, each with the child that leads here.
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
        let width = self.scales.len();
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
                    let mut ends = branch.boxes.chunks_exact(2 * CHILDREN).zip(&point.row);
                    branch.route(&point.row) == child
                        && branch.newest[child] >= point.revision
                        && branch.boxes.len() == 2 * CHILDREN * width
                        && ends.all(|(ends, &x)| ends[child] <= x && x <= ends[CHILDREN + child])
                };
                if !branches.iter().all(leads_here) || self.newest < point.revision {
                    return Err(format!("point {id} is outside of what should hold it"));
                }
            }
        }
        Ok(())
    }
}
