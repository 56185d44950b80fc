//! The invariants of a forest.

use std::{collections::HashSet, sync::Arc};

use super::Forest;
use crate::TreeReport;

/// The result of [`Forest::validate`], tree by tree.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ForestReport {
    /// The tree that grows by single points.
    pub growing: TreeReport,
    /// The levels, the largest first.
    pub levels: Vec<TreeReport>,
}

impl Forest {
    /// Checks every tree, that each id is alive at most once, that the counts agree, and that running merges
    /// hold levels of the forest.
    ///
    /// # Errors
    /// The first invariant found broken.
    pub fn validate(&self) -> Result<ForestReport, String> {
        let head = &self.head;
        if head.growing.is_full() {
            return Err("the growing tree is full".into());
        }
        let growing = head.growing.validate()?;
        let mut levels = Vec::with_capacity(head.levels.len());
        let mut alive: HashSet<u64> = HashSet::with_capacity(head.live);
        for point in head.growing.points_after(None, head.revision) {
            if !alive.insert(point.id) {
                return Err(format!(
                    "id {} is alive twice in the growing tree",
                    point.id
                ));
            }
        }
        for level in head.levels.iter() {
            levels.push(level.validate()?);
            for point in level.points_after(None, head.revision) {
                if !alive.insert(point.id) {
                    return Err(format!("id {} is alive twice", point.id));
                }
            }
        }
        if alive.len() != head.live {
            return Err(format!(
                "{} points are alive, not {}",
                alive.len(),
                head.live
            ));
        }
        if !head
            .levels
            .is_sorted_by_key(|level| std::cmp::Reverse(level.rows()))
        {
            return Err("the levels are not in the order of their sizes".into());
        }
        for source in self.running.iter().flat_map(|running| &running.sources) {
            let holders = self
                .running
                .iter()
                .filter(|running| running.has(source))
                .count();
            if holders != 1 || !head.levels.iter().any(|level| Arc::ptr_eq(level, source)) {
                return Err("a merge holds a level that is not its own".into());
            }
        }
        Ok(ForestReport { growing, levels })
    }
}
