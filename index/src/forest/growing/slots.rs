//! The way from an id to its point.

use std::ops::Bound;

use imbl::OrdMap;

use super::arrivals::Arrivals;
use crate::search::Table;

/// The latest slot of each id.
///
/// Ids that come in ascending order, as those that the server assigns do, need no map: their points are in the order of
/// their ids. (With a map for all of them, an insert in R3 took half as long again, under a snapshot too.) The first id that is
/// less than one before it, and all that come later, are in the map.
#[derive(Clone, Debug, Default)]
pub(super) struct Slots {
    /// So many points, from the first, came in ascending order of their ids.
    ascending: usize,
    /// The id of the last of them.
    greatest: u64,
    /// The latest slot of each id of those that came after.
    others: OrdMap<u64, u32>,
}

impl Slots {
    /// Notes the id of the point in `slot`, the next one.
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
    pub(super) fn find(&self, id: u64, arrivals: &Arrivals) -> Option<usize> {
        if let Some(&slot) = self.others.get(&id) {
            return Some(slot as usize);
        }
        if id > self.greatest {
            return None;
        }
        let slot = self.first(arrivals, |other| other >= id);
        (slot < self.ascending && arrivals.id(slot) == id).then_some(slot)
    }

    /// The slots of the ids above `after`, in the order of the ids. An id that came again may be there twice: only the latest is
    /// alive.
    pub(super) fn after(
        &self,
        after: Option<u64>,
        arrivals: &Arrivals,
    ) -> impl Iterator<Item = usize> {
        let first = after.map_or(0, |after| self.first(arrivals, |id| id > after));
        let mut ascending = (first..self.ascending).peekable();
        let start = after.map_or(Bound::Unbounded, Bound::Excluded);
        let others = self.others.range((start, Bound::Unbounded));
        let mut others = others.map(|(&id, &slot)| (id, slot as usize)).peekable();
        std::iter::from_fn(move || match (ascending.peek(), others.peek()) {
            (Some(&slot), Some(&(id, _))) if arrivals.id(slot) < id => ascending.next(),
            (_, Some(_)) => others.next().map(|(_, slot)| slot),
            (_, None) => ascending.next(),
        })
    }

    /// The first of the slots with ascending ids whose id is `beyond`, as are all after it; else the one after the last.
    fn first(&self, arrivals: &Arrivals, beyond: impl Fn(u64) -> bool) -> usize {
        let (mut start, mut end) = (0, self.ascending);
        while start < end {
            let middle = start.midpoint(end);
            if beyond(arrivals.id(middle)) {
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

    /// Points of these ids, one after the other.
    fn noted(ids: &[u64]) -> (Slots, Arrivals) {
        let (mut slots, mut arrivals) = (Slots::default(), Arrivals::new(1));
        for (slot, &id) in ids.iter().enumerate() {
            slots.push(id, slot);
            arrivals.push(PointRef {
                id,
                tag: 0,
                revision: 1,
                row: &[0.0],
            });
        }
        (slots, arrivals)
    }

    #[test]
    fn every_id_is_found_in_its_latest_slot_in_whatever_order_ids_come() {
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        for descents in [0, 1, 3, 300] {
            let mut ids: Vec<u64> = (0..300).map(|at| 10 + 3 * at).collect();
            for _ in 0..descents {
                let at = rng.random_range(0..ids.len());
                ids[at] = rng.random_range(9..920);
            }
            let (slots, arrivals) = noted(&ids);
            let latest: BTreeMap<u64, usize> = ids.iter().copied().zip(0..).collect();
            for id in 0..1000 {
                let expected = latest.get(&id).copied();
                assert_eq!(slots.find(id, &arrivals), expected, "{descents}, {id}");
            }
            for after in [None].into_iter().chain((0..1000).step_by(7).map(Some)) {
                let mut found: Vec<usize> = slots.after(after, &arrivals).collect();
                found.retain(|&slot| latest[&ids[slot]] == slot);
                let expected = latest.iter().filter(|&(&id, _)| after < Some(id));
                let expected: Vec<usize> = expected.map(|(_, &slot)| slot).collect();
                assert_eq!(found, expected, "{descents}, {after:?}");
            }
        }
    }

    #[test]
    fn ids_that_ascend_are_in_no_map() {
        let (slots, _) = noted(&[0, 1, 7, u64::MAX >> 1]);
        assert_eq!((slots.ascending, slots.memory_bytes()), (4, 0));
        let (slots, arrivals) = noted(&[5, 6, 6, 7]);
        assert_eq!((slots.ascending, slots.others.len()), (2, 2));
        assert_eq!(slots.find(6, &arrivals), Some(2));
    }

    #[test]
    fn no_points_have_no_ids() {
        let (slots, arrivals) = noted(&[]);
        assert_eq!(slots.find(0, &arrivals), None);
        assert_eq!(slots.after(None, &arrivals).count(), 0);
    }
}
