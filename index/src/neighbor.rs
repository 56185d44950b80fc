//! Neighbours, their total order, and the collector that keeps the nearest.

use std::{cmp::Ordering, collections::BinaryHeap};

/// A stored point at a distance from the state that was asked about.
///
/// Ordered by (distance, id): a total order, so that an answer is the same whatever structure found it.
#[derive(Clone, Copy, Debug)]
pub struct Neighbor {
    /// The distance in the space's metric, never squared.
    pub distance: f64,
    /// The point's id.
    pub id: u64,
}

impl Ord for Neighbor {
    fn cmp(&self, other: &Self) -> Ordering {
        self.distance
            .total_cmp(&other.distance)
            .then(self.id.cmp(&other.id))
    }
}

impl PartialOrd for Neighbor {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl PartialEq for Neighbor {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other).is_eq()
    }
}

impl Eq for Neighbor {}

/// Up to so many neighbours are kept in order: cheaper than a heap, whose every change runs from end to end of it.
const IN_ORDER: usize = 48;

/// Keeps the `k` least neighbours, in their total order, of those within a closed radius.
pub(crate) struct Collector {
    k: usize,
    worst: f64,
    held: Held,
}

enum Held {
    Ascending(Vec<Neighbor>),
    Heap(BinaryHeap<Neighbor>),
}

impl Collector {
    pub(crate) fn new(k: usize, radius: f64) -> Self {
        Self {
            k,
            worst: if k == 0 { f64::NEG_INFINITY } else { radius },
            held: if k <= IN_ORDER {
                Held::Ascending(Vec::with_capacity(k))
            } else {
                Held::Heap(BinaryHeap::new())
            },
        }
    }

    /// A point farther than this cannot enter; one *at* this distance may, by its id.
    #[inline]
    pub(crate) fn worst(&self) -> f64 {
        self.worst
    }

    pub(crate) fn len(&self) -> usize {
        match &self.held {
            Held::Ascending(held) => held.len(),
            Held::Heap(held) => held.len(),
        }
    }

    /// Keeps a neighbour, if it is near enough; whether that has made the worst distance smaller.
    pub(crate) fn offer(&mut self, neighbor: Neighbor) -> bool {
        if self.k == 0 || neighbor.distance > self.worst {
            return false;
        }
        let last = match &mut self.held {
            Held::Ascending(held) => {
                if held.len() == self.k {
                    if held.last().is_some_and(|last| *last <= neighbor) {
                        return false;
                    }
                    held.pop();
                }
                let place = held
                    .iter()
                    .rev()
                    .take_while(|held| **held > neighbor)
                    .count();
                held.insert(held.len() - place, neighbor);
                (held.len() == self.k).then(|| held.last()).flatten()
            }
            Held::Heap(held) => {
                if held.len() < self.k {
                    held.push(neighbor);
                } else if let Some(mut last) = held.peek_mut()
                    && neighbor < *last
                {
                    *last = neighbor;
                }
                (held.len() == self.k).then(|| held.peek()).flatten()
            }
        };
        match last {
            Some(last) if last.distance < self.worst => {
                self.worst = last.distance;
                true
            }
            _ => false,
        }
    }

    pub(crate) fn into_sorted(self) -> Vec<Neighbor> {
        match self.held {
            Held::Ascending(held) => held,
            Held::Heap(held) => {
                let mut held = held.into_vec();
                held.sort_unstable();
                held
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ties_go_to_the_lesser_id_whatever_the_order_of_arrival() {
        for ids in [[3, 1, 2], [1, 2, 3], [2, 3, 1]] {
            let mut collector = Collector::new(2, f64::INFINITY);
            for id in ids {
                collector.offer(Neighbor { distance: 1.0, id });
            }
            let held: Vec<u64> = collector.into_sorted().iter().map(|n| n.id).collect();
            assert_eq!(held, [1, 2]);
        }
    }

    #[test]
    fn the_radius_is_closed() {
        let mut collector = Collector::new(usize::MAX, 1.0);
        for (id, distance) in [(0, 1.0), (1, f64::from_bits(1.0f64.to_bits() + 1))] {
            collector.offer(Neighbor { distance, id });
        }
        assert_eq!(collector.into_sorted().len(), 1);
    }
}
