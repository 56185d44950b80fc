//! Neighbours and their total order.

use std::cmp::Ordering;

/// A stored point, with its distance from the state of a search.
///
/// Neighbours are ordered by (distance, id). The order is total, so every structure gives the same answer.
#[derive(Clone, Copy, Debug)]
pub struct Neighbor {
    /// The distance in the space's metric, never squared.
    pub distance: f64,
    /// The point's id.
    pub id: u64,
}

impl Neighbor {
    /// One number in the order of neighbours, which is compared without a branch. No distance is negative, so its bits
    /// are in its order.
    #[inline]
    pub(crate) fn order(&self) -> u128 {
        u128::from(self.distance.to_bits()) << 64 | u128::from(self.id)
    }
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
