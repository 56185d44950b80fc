//! The slots of ids.

use std::ops::Bound;

use imbl::OrdMap;

use super::insertion_log::InsertionLog;
use crate::traversal::Labels;

/// The latest slot of each id.
///
/// Ids in ascending order, as the server assigns them, need no map: their points are sorted by id. A map of all ids
/// would slow every insert. The first id that is less than an earlier one, and all ids after it, are in the map.
#[derive(Clone, Debug, Default)]
pub(super) struct Ids {
    /// The number of points, from the first on, with ids in ascending order.
    ascending: usize,
    /// The id of the last of them.
    greatest: u64,
    /// The latest slot of each id that came after them.
    others: OrdMap<u64, u32>,
}

impl Ids {
    /// Adds the id of the point in `slot`, the next one.
    pub(super) fn push(&mut self, id: u64, slot: usize) {
        let ascends = slot == 0 || id > self.greatest;
        if slot == self.ascending && ascends {
            self.ascending += 1;
            self.greatest = id;
        } else {
            self.others.insert(id, slot as u32);
        }
    }

    /// The latest slot of an id.
    pub(super) fn find(&self, id: u64, log: &InsertionLog) -> Option<usize> {
        if let Some(&slot) = self.others.get(&id) {
            return Some(slot as usize);
        }
        if id > self.greatest {
            return None;
        }
        let slot = self.first(log, |other| other >= id);
        (slot < self.ascending && log.id(slot) == id).then_some(slot)
    }

    /// The slots of the ids above `after`, in the order of the ids. An id that came again may occur twice; only its
    /// latest slot is alive.
    pub(super) fn after(
        &self,
        after: Option<u64>,
        log: &InsertionLog,
    ) -> impl Iterator<Item = usize> {
        let first = after.map_or(0, |after| self.first(log, |id| id > after));
        let mut ascending = (first..self.ascending).peekable();
        let start = after.map_or(Bound::Unbounded, Bound::Excluded);
        let others = self.others.range((start, Bound::Unbounded));
        let mut others = others.map(|(&id, &slot)| (id, slot as usize)).peekable();
        std::iter::from_fn(move || match (ascending.peek(), others.peek()) {
            (Some(&slot), Some(&(id, _))) if log.id(slot) < id => ascending.next(),
            (_, Some(_)) => others.next().map(|(_, slot)| slot),
            (_, None) => ascending.next(),
        })
    }

    /// The first of the slots with ascending ids whose id is `beyond`, or the slot after the last. All ids after it are
    /// `beyond` too.
    fn first(&self, log: &InsertionLog, beyond: impl Fn(u64) -> bool) -> usize {
        let (mut start, mut end) = (0, self.ascending);
        while start < end {
            let middle = start.midpoint(end);
            if beyond(log.id(middle)) {
                end = middle;
            } else {
                start = middle + 1;
            }
        }
        start
    }

    pub(super) fn memory_bytes(&self) -> usize {
        // A node of a B-tree is between half full and full.
        self.others.len() * size_of::<(u64, u32)>() * 3 / 2
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;
    use crate::PointRef;

    /// A log of points with these ids.
    fn log_of(ids: &[u64]) -> (Ids, InsertionLog) {
        let (mut index, mut log) = (Ids::default(), InsertionLog::new(1));
        for (slot, &id) in ids.iter().enumerate() {
            index.push(id, slot);
            log.push(PointRef {
                id,
                tag: 0,
                revision: 1,
                row: &[0.0],
            });
        }
        (index, log)
    }

    #[test]
    fn every_id_is_found_in_its_latest_slot_in_any_order_of_ids() {
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        for descents in [0, 1, 3, 300] {
            let mut ids: Vec<u64> = (0..300).map(|at| 10 + 3 * at).collect();
            for _ in 0..descents {
                let at = rng.random_range(0..ids.len());
                ids[at] = rng.random_range(9..920);
            }
            let (index, log) = log_of(&ids);
            let latest: BTreeMap<u64, usize> = ids.iter().copied().zip(0..).collect();
            for id in 0..1000 {
                let expected = latest.get(&id).copied();
                assert_eq!(index.find(id, &log), expected, "{descents}, {id}");
            }
            for after in [None].into_iter().chain((0..1000).step_by(7).map(Some)) {
                let mut found: Vec<usize> = index.after(after, &log).collect();
                found.retain(|&slot| latest[&ids[slot]] == slot);
                let expected = latest.iter().filter(|&(&id, _)| after < Some(id));
                let expected: Vec<usize> = expected.map(|(_, &slot)| slot).collect();
                assert_eq!(found, expected, "{descents}, {after:?}");
            }
        }
    }

    #[test]
    fn ids_that_ascend_are_in_no_map() {
        let (index, _) = log_of(&[0, 1, 7, u64::MAX >> 1]);
        assert_eq!((index.ascending, index.memory_bytes()), (4, 0));
        let (index, log) = log_of(&[5, 6, 6, 7]);
        assert_eq!((index.ascending, index.others.len()), (2, 2));
        assert_eq!(index.find(6, &log), Some(2));
    }

    #[test]
    fn no_points_have_no_ids() {
        let (index, log) = log_of(&[]);
        assert_eq!(index.find(0, &log), None);
        assert_eq!(index.after(None, &log).count(), 0);
    }
}
