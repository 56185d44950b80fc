//! Answers after a reload.

use wayfold_index::{Forest, ForestOptions, Points};

use super::*;

/// The neighbours after a reload of a point 0, whose insert found `found`. The other points are ids, tags and places.
fn superset(
    search: &Search<'_>,
    found: &[Neighbor],
    others: impl Iterator<Item = (u64, u64, f64)>,
) -> Vec<u64> {
    let space: Space = "R1".parse().unwrap();
    let mut points = Points::new(1);
    for (id, tag, x) in others.chain([(0, 1, 0.0)]) {
        points.push(id, tag, 1, &[x]);
    }
    let mut forest = Forest::new(space.clone(), ForestOptions::for_space(&space));
    forest.apply(1, &points, &[]).unwrap();
    let mut open = OpenSearch::new((0, 0), &[0.0], search, found, 1);
    open.search_all();
    let answerable = Answerable {
        searches: vec![open],
        arrived: Vec::new(),
        departure: 0,
        snapshot: Some(forest.snapshot()),
    };
    let answer = answerable.answers(&space).next().unwrap();
    assert!(answer.is_superset);
    let ids = answer.neighbors.iter().map(|neighbor| neighbor.id);
    ids.collect()
}

const NEAREST: Neighbor = Neighbor {
    distance: 1.0,
    id: 1,
};

/// The insert found the point 1 at distance 1. While the copy was read again, the point stayed, left, moved or lost
/// its tag; the point 2, at distance 3, is the nearest neighbour then.
#[test]
fn a_reload_misses_no_neighbour_in_place_of_one_that_left() {
    let mut search = Search::nearest_k(1);
    (search.filter.tag_mask, search.filter.tag_value) = (1, 1);
    let answer = |first: Option<(u64, f64)>| {
        let first = first.map(|(tag, x)| (1, tag, x));
        superset(&search, &[NEAREST], first.into_iter().chain([(2, 1, 3.0)]))
    };
    assert_eq!(answer(Some((1, 1.0))), [1]);
    assert_eq!(answer(None), [2]);
    assert_eq!(answer(Some((1, 5.0))), [2, 1]);
    assert_eq!(answer(Some((0, 1.0))), [2]);
}

/// The copy had fewer points than the search asked for.
#[test]
fn a_superset_without_a_bound_has_a_limit() {
    let count = MAX_SUPERSET as u64 + 10;
    let others = (1..=count).map(|id| (id, 0, id as f64));
    let found = superset(&Search::nearest_k(2), &[NEAREST], others);
    // One of them is the point itself.
    assert!(found.iter().copied().eq(1..MAX_SUPERSET as u64));
}
