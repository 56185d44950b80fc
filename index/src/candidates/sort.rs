//! Sorting many neighbours.

use std::mem;

use crate::Neighbor;

/// The least number of neighbours that are put into buckets. Fewer are sorted as fast by comparing.
const MIN_BUCKETED: usize = 48;

/// The greatest number of neighbours that are put into buckets. The copies of more would leave the cache, and be a large
/// part of the memory of a search.
const MAX_BUCKETED: usize = 1 << 16;

/// Distances get denser towards the farthest, so one bucket for each would be too few.
const BUCKETS_PER_NEIGHBOR: usize = 2;

/// The greatest number of neighbours in a bucket. With more, a sort that compares takes less time.
const MAX_IN_BUCKET: u32 = 64;

/// Sorts neighbours in their order.
///
/// Buckets of equal ranges of distances bring each neighbour within a few places of its own. That takes about half of
/// the time of a sort that only compares, for a hundred neighbours and for ten thousand.
pub(super) fn sort(neighbors: &mut Vec<Neighbor>) {
    let count = neighbors.len();
    if !(MIN_BUCKETED..=MAX_BUCKETED).contains(&count) || !distribute(neighbors) {
        neighbors.sort_unstable_by_key(Neighbor::order);
        return;
    }
    // By insertion: no neighbour leaves its bucket.
    for at in 1..count {
        let (neighbor, mut place) = (neighbors[at], at);
        while place > 0 && neighbors[place - 1].order() > neighbor.order() {
            neighbors[place] = neighbors[place - 1];
            place -= 1;
        }
        neighbors[place] = neighbor;
    }
}

/// Puts neighbours into the order of their buckets. If a bucket has too many, it returns false and changes nothing.
fn distribute(neighbors: &mut Vec<Neighbor>) -> bool {
    // No distance is negative, so its bits are in its order.
    let bits = neighbors.iter().map(|neighbor| neighbor.distance.to_bits());
    let (nearest, farthest) = bits.fold((u64::MAX, 0), |(least, most), bits| {
        (least.min(bits), most.max(bits))
    });
    let nearest = f64::from_bits(nearest);
    let count = BUCKETS_PER_NEIGHBOR * neighbors.len();
    let per_distance = (count - 1) as f64 / (f64::from_bits(farthest) - nearest);
    // Rounding is monotone, so a farther neighbour is in no lower bucket. A product that is no number becomes bucket 0:
    // either it is that of the nearest distance, or the farthest is infinite and all are in that bucket.
    let bucket_of = |neighbor: &Neighbor| {
        // By `i64`: the conversion to `usize` takes more instructions.
        let bucket = ((neighbor.distance - nearest) * per_distance) as i64;
        (bucket as usize).min(count - 1)
    };
    let mut places = vec![0_u32; count];
    let mut buckets = Vec::with_capacity(neighbors.len());
    for neighbor in &*neighbors {
        let bucket = bucket_of(neighbor);
        places[bucket] += 1;
        buckets.push(bucket as u32);
    }
    let mut start = 0;
    for place in &mut places {
        if *place > MAX_IN_BUCKET {
            return false;
        }
        start += mem::replace(place, start);
    }
    let mut distributed = neighbors.clone();
    for (&neighbor, bucket) in neighbors.iter().zip(buckets) {
        let place = &mut places[bucket as usize];
        distributed[*place as usize] = neighbor;
        *place += 1;
    }
    *neighbors = distributed;
    true
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::space::tests::cases;

    /// A distance that is often near others or equal to one, and seldom at an end of the numbers.
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
                prop::collection::vec((0..400u16).prop_map(f64::from), 0..2000),
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
    fn even_distances_are_distributed_and_crowds_stay_as_they_are() {
        let even = |id: u64| Neighbor {
            distance: (id * 7919 % 1000) as f64,
            id,
        };
        let mut neighbors: Vec<Neighbor> = (0..1000).map(even).collect();
        assert!(distribute(&mut neighbors));
        neighbors[0].distance = 1e9;
        let crowded = neighbors.clone();
        assert!(!distribute(&mut neighbors));
        assert_eq!(neighbors, crowded);
    }
}
