//! Sorting many neighbours.

use std::{mem, ops::RangeInclusive};

use crate::Neighbor;

/// The numbers of neighbours that are spread over buckets. Fewer are sorted by comparing as fast, and the copies of more
/// would leave the cache and be a large part of the memory of a search.
const SPREAD: RangeInclusive<usize> = 48..=1 << 16;

/// The buckets for each neighbour: the distances of neighbours are denser the greater they are.
const BUCKETS: usize = 2;

/// The greatest number of neighbours in a bucket. More are sorted by comparing, which takes less time then.
const MAX_IN_BUCKET: u32 = 64;

/// Sorts neighbours in their order.
///
/// Buckets of equal ranges of distances bring each neighbour within a few places of its own. That takes about half of
/// the time of a sort that only compares, for a hundred neighbours and for ten thousand.
pub(super) fn sort(neighbors: &mut Vec<Neighbor>) {
    if !SPREAD.contains(&neighbors.len()) || !spread(neighbors) {
        neighbors.sort_unstable_by_key(Neighbor::order);
        return;
    }
    // By insertion: no neighbour leaves its bucket.
    for at in 1..neighbors.len() {
        let (neighbor, mut place) = (neighbors[at], at);
        while place > 0 && neighbors[place - 1].order() > neighbor.order() {
            neighbors[place] = neighbors[place - 1];
            place -= 1;
        }
        neighbors[place] = neighbor;
    }
}

/// Puts neighbours into the order of their buckets. False, and nothing is changed, if a bucket has too many.
fn spread(neighbors: &mut Vec<Neighbor>) -> bool {
    // No distance is negative, so its bits are in its order.
    let bits = neighbors.iter().map(|neighbor| neighbor.distance.to_bits());
    let (nearest, farthest) = bits.fold((u64::MAX, 0), |(least, most), bits| {
        (least.min(bits), most.max(bits))
    });
    let nearest = f64::from_bits(nearest);
    let buckets = BUCKETS * neighbors.len();
    let per_distance = (buckets - 1) as f64 / (f64::from_bits(farthest) - nearest);
    // Rounding is monotone, so a farther neighbour is in no lower bucket. A product that is no number becomes bucket 0:
    // either it is that of the nearest distance, or the farthest is infinite and all are in that bucket.
    let bucket = |neighbor: &Neighbor| {
        let bucket = (neighbor.distance - nearest) * per_distance;
        (bucket as i64 as usize).min(buckets - 1)
    };
    let mut starts = vec![0_u32; buckets];
    let of: Vec<u32> = neighbors
        .iter()
        .map(|neighbor| {
            let bucket = bucket(neighbor);
            starts[bucket] += 1;
            bucket as u32
        })
        .collect();
    let mut start = 0;
    for count in &mut starts {
        if *count > MAX_IN_BUCKET {
            return false;
        }
        start += mem::replace(count, start);
    }
    let mut spread = neighbors.clone();
    for (&neighbor, bucket) in neighbors.iter().zip(of) {
        let place = &mut starts[bucket as usize];
        spread[*place as usize] = neighbor;
        *place += 1;
    }
    *neighbors = spread;
    true
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::space::tests::cases;

    /// Distances of which many are equal, near each other, or at an end of the numbers.
    fn distance() -> impl Strategy<Value = f64> {
        prop_oneof![
            40 => (0.0..1.0_f64).prop_map(|x| x.powf(1.0 / 6.0)),
            4 => (0..50u8).prop_map(f64::from),
            1 => prop_oneof![Just(0.0), Just(5e-324), Just(1e300), Just(f64::MAX), Just(f64::INFINITY)],
        ]
    }

    proptest! {
        #![proptest_config(cases(300))]

        #[test]
        fn the_order_is_that_of_a_sort(
            distances in prop_oneof![
                prop::collection::vec(distance(), 0..400),
                prop::collection::vec((0.5..1.0_f64).prop_map(f64::sqrt), 0..400),
                prop::collection::vec(prop_oneof![Just(0.0), Just(5e-324), Just(1e-323)], 0..200),
                prop::collection::vec(Just(f64::INFINITY), 0..200),
            ],
        ) {
            let of = |(id, distance): (usize, &f64)| Neighbor { distance: *distance, id: id as u64 };
            let mut neighbors: Vec<Neighbor> = distances.iter().enumerate().map(of).rev().collect();
            let mut expected = neighbors.clone();
            expected.sort();
            sort(&mut neighbors);
            prop_assert_eq!(neighbors, expected);
        }
    }

    #[test]
    fn many_are_spread_and_crowds_are_not() {
        let even = |id: u64| Neighbor {
            distance: (id * 7919 % 1000) as f64,
            id,
        };
        let mut neighbors: Vec<Neighbor> = (0..1000).map(even).collect();
        assert!(spread(&mut neighbors));
        neighbors[0].distance = 1e9;
        assert!(!spread(&mut neighbors));
    }
}
