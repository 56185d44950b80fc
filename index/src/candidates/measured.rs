//! The candidates for a large `k`, or within a radius.
//!
//! Most points of a block are candidates then, so their distances are computed side by side and the points are held by
//! them. The list is in no order. Once in a while the `k` nearest are selected, which costs less for each candidate
//! than a heap, and the limit is only a little greater meanwhile.

use super::sort::sort;
use crate::Neighbor;

/// The least number of candidates between two selections. Fewer would cost more than what the lower limit rules out.
const MIN_BETWEEN_SELECTIONS: usize = 64;

/// A search reserves room for at most this number of candidates: within a radius it may find few.
const MAX_RESERVED: usize = 256;

/// The candidates for the `k` nearest.
pub(crate) struct MeasuredCandidates {
    k: usize,
    /// A point at a greater distance is no answer.
    max_distance: f64,
    neighbors: Vec<Neighbor>,
    /// The number of candidates at which the nearest are selected.
    full: usize,
}

impl MeasuredCandidates {
    /// No candidates yet for the `k` nearest points up to `radius`; `k` is at least 1.
    pub(crate) fn new(k: usize, radius: f64) -> Self {
        debug_assert_ne!(k, 0);
        // A selection reads all candidates. So many arrive between two of them that a candidate costs a few reads.
        let full = k.saturating_add((k / 4).max(MIN_BETWEEN_SELECTIONS));
        Self {
            k,
            max_distance: radius,
            neighbors: Vec::with_capacity(full.min(MAX_RESERVED)),
            full,
        }
    }

    /// The number of candidates, up to `k`.
    pub(crate) fn len(&self) -> usize {
        self.neighbors.len().min(self.k)
    }

    /// Adds a point. Returns the distance above which no point is an answer, if that became less.
    #[inline(always)]
    pub(crate) fn offer(&mut self, neighbor: Neighbor) -> Option<f64> {
        if neighbor.distance > self.max_distance {
            return None;
        }
        self.neighbors.push(neighbor);
        if self.neighbors.len() < self.full {
            return None;
        }
        self.select()
    }

    /// Keeps the `k` nearest.
    #[cold]
    fn select(&mut self) -> Option<f64> {
        let (_, last, _) = (self.neighbors).select_nth_unstable_by_key(self.k - 1, Neighbor::order);
        let farthest = last.distance;
        self.neighbors.truncate(self.k);
        let is_less = farthest < self.max_distance;
        self.max_distance = farthest.min(self.max_distance);
        is_less.then_some(farthest)
    }

    /// Removes and returns the `k` nearest, in their order.
    pub(crate) fn take_sorted(&mut self) -> Vec<Neighbor> {
        if self.neighbors.len() > self.k {
            self.select();
        }
        let mut nearest = std::mem::take(&mut self.neighbors);
        sort(&mut nearest);
        // Callers hold many answers, and count the neighbours in them.
        if nearest.capacity() > 2 * nearest.len() {
            nearest.shrink_to_fit();
        }
        nearest
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::space::tests::cases;

    proptest! {
        #![proptest_config(cases(500))]

        /// The points taken are the first `k` of those within the radius, in whatever order they came.
        #[test]
        fn the_nearest_are_left(
            distances in prop::collection::vec(0..40u8, 0..700),
            k in prop_oneof![1..5usize, 63..130usize, Just(usize::MAX)],
            radius in prop_oneof![Just(f64::INFINITY), (0..40u8).prop_map(f64::from)],
        ) {
            let of = |(id, &distance): (usize, &u8)| Neighbor { distance: f64::from(distance), id: id as u64 };
            let all: Vec<Neighbor> = distances.iter().enumerate().map(of).collect();
            let mut sorted: Vec<Neighbor> = all.iter().copied().filter(|one| one.distance <= radius).collect();
            sorted.sort();
            sorted.truncate(k);
            let (mut measured, mut max_distance) = (MeasuredCandidates::new(k, radius), radius);
            for &neighbor in &all {
                if let Some(lower) = measured.offer(neighbor) {
                    prop_assert!(lower < max_distance);
                    max_distance = lower;
                }
                prop_assert!(measured.len() <= k);
            }
            prop_assert!(sorted.iter().all(|one| one.distance <= max_distance));
            let taken = measured.take_sorted();
            prop_assert!(taken.capacity() <= 2 * taken.len());
            prop_assert_eq!(taken, sorted);
        }
    }
}
