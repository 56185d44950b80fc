//! A level that never grew: a static tree, the slots of its ids, and the tombstones of its dead points.

use std::sync::Arc;

use super::{
    level::PointsById,
    tombstones::{LATEST, Tombstones},
};
use crate::{
    KdTree, Point, Points, Space, TreeReport, kdtree::TreeSearch, lanes::Isa, traversal::Traversal,
};

/// A static tree as a level of a forest. Its ids are distinct.
#[derive(Debug)]
pub(super) struct StaticLevel {
    tree: KdTree,
    /// The slots in the order of their ids.
    by_id: Vec<u32>,
    tombstones: Tombstones,
    /// True if a merge has built the tree. (A packed tree may also have one leaf.)
    packed: bool,
}

impl StaticLevel {
    /// A level of one leaf, which is scanned until a merge packs it.
    pub(super) fn unpacked(space: Arc<Space>, points: &Points) -> Self {
        Self::over(KdTree::build(space, points, points.len()), false)
    }

    /// A level with its tree.
    pub(super) fn packed(space: Arc<Space>, points: &Points, leaf_rows: usize) -> Self {
        Self::over(KdTree::build(space, points, leaf_rows), true)
    }

    fn over(tree: KdTree, packed: bool) -> Self {
        let by_id = by_id(tree.ids());
        Self {
            tree,
            by_id,
            tombstones: Tombstones::default(),
            packed,
        }
    }

    /// The number of points stored, dead ones included.
    pub(super) fn rows(&self) -> usize {
        self.tree.len()
    }

    /// The number of points dead at the head.
    pub(super) fn dead(&self) -> usize {
        self.tombstones.dead()
    }

    /// True if a merge has built the tree.
    pub(super) fn is_packed(&self) -> bool {
        self.packed
    }

    pub(super) fn get(&self, slot: usize) -> Point {
        self.tree.get(slot)
    }

    /// Appends a copy of the point in `slot` to `points`.
    pub(super) fn copy_to(&self, slot: usize, points: &mut Points) {
        self.tree.copy_to(slot, points);
    }

    pub(super) fn is_visible(&self, slot: usize, revision: u64) -> bool {
        self.tombstones.is_visible(slot, revision)
    }

    /// The slot of the point with this id, if a reader at `revision` sees it.
    pub(super) fn find(&self, id: u64, revision: u64) -> Option<usize> {
        let ids = self.tree.ids();
        let (&first, &last) = (self.by_id.first()?, self.by_id.last()?);
        if id < ids[first as usize] || id > ids[last as usize] {
            return None;
        }
        let at = self
            .by_id
            .binary_search_by_key(&id, |&slot| ids[slot as usize])
            .ok()?;
        let slot = self.by_id[at] as usize;
        self.is_visible(slot, revision).then_some(slot)
    }

    /// The points that a reader at `revision` sees above the id `after`.
    pub(super) fn points_after(&self, after: Option<u64>, revision: u64) -> PointsById<'_> {
        let ids = self.tree.ids();
        let start = after.map_or(0, |after| {
            self.by_id
                .partition_point(|&slot| ids[slot as usize] <= after)
        });
        let slots = self.by_id[start..].iter().map(|&slot| slot as usize);
        let visible = slots.filter(move |&slot| self.is_visible(slot, revision));
        Box::new(visible.map(|slot| self.get(slot)))
    }

    /// Removes the point in `slot` as of `revision`.
    pub(super) fn mark_dead(&self, slot: usize, revision: u64) {
        self.tombstones.mark_dead(slot, self.rows(), revision);
    }

    /// Searches the points that a reader at `revision` sees.
    #[inline(always)]
    pub(super) fn search<'a, I: Isa>(&'a self, traversal: &mut Traversal<'a>, revision: u64) {
        if self.tombstones.dead() == 0 {
            // A tombstone at or before the reader's revision was published with it, and would be seen here.
            traversal.search::<I, _>(&mut TreeSearch::new(&self.tree, |_| true));
        } else {
            let is_visible = |slot: usize| self.is_visible(slot, revision);
            traversal.search::<I, _>(&mut TreeSearch::new(&self.tree, is_visible));
        }
    }

    pub(super) fn memory_bytes(&self) -> usize {
        self.tree.memory_bytes() + 4 * self.by_id.capacity() + self.tombstones.memory_bytes()
    }

    pub(super) fn validate(&self) -> Result<TreeReport, String> {
        let report = self.tree.validate()?;
        let ids = self.tree.ids();
        if self.by_id.len() != ids.len() {
            return Err("the ids of a level are not all in order".into());
        }
        for pair in self.by_id.windows(2) {
            if ids[pair[0] as usize] >= ids[pair[1] as usize] {
                return Err(format!(
                    "id {} stands twice in a level",
                    ids[pair[1] as usize]
                ));
            }
        }
        let dead = (0..self.rows())
            .filter(|&slot| !self.is_visible(slot, LATEST))
            .count();
        if dead != self.dead() {
            return Err(format!(
                "{dead} points of a level are dead, not {}",
                self.dead()
            ));
        }
        Ok(report)
    }
}

/// The mean distance between ids from which on they are sorted. Denser ids, such as those that the server assigns, are
/// put into a table by their value.
const SPARSE: u64 = 4;

/// The slots of distinct `ids`, in the order of the ids.
fn by_id(ids: &[u64]) -> Vec<u32> {
    let least = ids.iter().copied().min().unwrap_or_default();
    let span = ids.iter().map(|id| id - least).max().unwrap_or_default();
    let slots = 0..ids.len() as u32;
    if span / SPARSE >= ids.len() as u64 {
        let mut slots: Vec<u32> = slots.collect();
        slots.sort_unstable_by_key(|&slot| ids[slot as usize]);
        return slots;
    }
    // A tree has fewer slots.
    const NONE: u32 = u32::MAX;
    let mut places = vec![NONE; span as usize + 1];
    for slot in slots {
        places[(ids[slot as usize] - least) as usize] = slot;
    }
    places.retain(|&slot| slot != NONE);
    places.shrink_to_fit();
    places
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn slots_are_in_the_order_of_their_ids_at_any_distance_of_these() {
        for (count, step) in [
            (0, 1),
            (1, 1),
            (100, 1),
            (100, 3),
            (100, 4),
            (100, 5),
            (9, 1 << 59),
        ] {
            // 77 shares no divisor with the counts: each id once, out of order.
            let mixed = |slot: u64| slot * 7 * 11 % count.max(1);
            let ids: Vec<u64> = (0..count).map(|slot| 5 + mixed(slot) * step).collect();
            let mut expected: Vec<u32> = (0..count as u32).collect();
            expected.sort_by_key(|&slot| ids[slot as usize]);
            assert_eq!(by_id(&ids), expected, "{count} {step}");
        }
    }
}
