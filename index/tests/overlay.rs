//! A snapshot under overlays answers as one set of points with all their changes.

use std::collections::{BTreeMap, HashSet};

use proptest::prelude::*;
use wayfold_index::{
    EarlierAnswer, Filter, Forest, ForestOptions, Linear, Overlay, Point, PointRef, Points, Search,
    Space, search_overlaid,
};

/// The ids that a change stores with a coordinate, and the ids that it removes.
type Changes = BTreeMap<u64, Option<u8>>;

fn changes() -> impl Strategy<Value = Changes> {
    prop::collection::btree_map(0..150u64, prop::option::weighted(0.8, 0..8u8), 0..120)
}

/// The rows that some changes store, and the ids that they remove.
fn rows(changes: &Changes, revision: u64) -> (Points, Vec<u64>) {
    let (mut stored, mut removed) = (Points::new(1), Vec::new());
    for (&id, at) in changes {
        match at {
            Some(at) => stored.push(id, u64::from(*at) & 1, revision, &[f64::from(*at)]),
            None => removed.push(id),
        }
    }
    (stored, removed)
}

/// A forest can have points at revision 0: those it was loaded with.
#[test]
fn points_of_revision_0_are_found_once() {
    let space: Space = "R1".parse().unwrap();
    let points = |id, revision| rows(&Changes::from([(id, Some(3))]), revision).0;
    let mut forest = Forest::new(space.clone(), ForestOptions::for_space(&space));
    forest.load(&points(1, 0)).unwrap();
    let search = Search::nearest_k(3);
    let loaded = forest.search(&[0.0], &search).unwrap().neighbors;
    for revision in 1..3 {
        let snapshot = forest.snapshot();
        let known = EarlierAnswer {
            revision: 0,
            neighbors: &loaded,
        };
        let expected = forest.search(&[0.0], &search).unwrap().neighbors;
        for known in [None, Some(known)] {
            let found = search_overlaid(&snapshot, &[], known, &[0.0], &search).unwrap();
            assert_eq!(found, expected);
        }
        forest.apply(revision, &points(2, revision), &[]).unwrap();
    }
}

proptest! {
    #![proptest_config(ProptestConfig {
        cases: 512,
        rng_seed: proptest::test_runner::RngSeed::Fixed(7),
        failure_persistence: None,
        ..ProptestConfig::default()
    })]

    /// On a grid most distances are ties.
    #[test]
    fn overlays_answer_as_one_set(
        base in changes(),
        added in prop::collection::btree_map(150..170u64, (0..8u8).prop_map(Some), 0..20),
        layers in prop::collection::vec(changes(), 0..4),
        query in 0..8u8,
        k in prop_oneof![0..6usize, Just(usize::MAX)],
        radius in prop_oneof![(0..5u8).prop_map(f64::from), Just(f64::INFINITY)],
        tagged in any::<bool>(),
        since_revision in 0..5u64,
        excluded in prop::collection::hash_set(0..150u64, 0..3),
    ) {
        let space: Space = "R1".parse().unwrap();
        let mut forest = Forest::new(space.clone(), ForestOptions::for_space(&space));
        let mut expected = BTreeMap::new();
        let mut overlays = Vec::new();
        let mut earlier = forest.snapshot();
        for (at, changes) in [&base, &added].into_iter().chain(&layers).enumerate() {
            let revision = at as u64 + 1;
            let (stored, removed) = rows(changes, revision);
            for id in &removed {
                expected.remove(id);
            }
            for point in stored.iter() {
                expected.insert(point.id, point.to_point());
            }
            if at < 2 {
                earlier = forest.snapshot();
                forest.apply(revision, &stored, &removed).unwrap();
                continue;
            }
            let mut overlay = Overlay::new(space.clone());
            overlay.apply(&stored, &removed).unwrap();
            overlays.push(overlay);
        }
        let overlays: Vec<&Overlay> = overlays.iter().collect();
        for id in 0..170 {
            let changed = overlays.iter().rev().find_map(|overlay| overlay.get(id));
            let found = changed.unwrap_or_else(|| forest.get(id));
            prop_assert_eq!(found.as_ref(), expected.get(&id));
        }

        let mut linear = Linear::new(space.clone());
        for Point { id, tag, revision, row } in expected.values() {
            let point = PointRef { id: *id, tag: *tag, revision: *revision, row };
            linear.insert(point).unwrap();
        }
        let sets: [&HashSet<u64>; 1] = [&excluded];
        let search = Search {
            radius,
            filter: Filter {
                tag_mask: u64::from(tagged),
                tag_value: u64::from(tagged),
                since_revision,
            },
            excluded: &sets,
            ..Search::nearest_k(k)
        };
        let query = [f64::from(query)];
        let snapshot = forest.snapshot();
        let found = search_overlaid(&snapshot, &overlays, None, &query, &search).unwrap();
        let truth = linear.search(&query, &search).unwrap().neighbors;
        prop_assert_eq!(&found, &truth);

        // With the neighbours of the snapshot, or of an earlier one. The oldest overlay has points of the snapshot.
        let only_new = overlays.iter().all(|overlay| {
            (0..170).all(|id| forest.get(id).is_none() || overlay.get(id).is_none())
        });
        if only_new {
            let mut oldest = Overlay::new(space.clone());
            oldest.apply(&rows(&added, 2).0, &[]).unwrap();
            let overlays: Vec<&Overlay> = [&oldest].into_iter().chain(overlays).collect();
            // The earlier search excluded the same points, or none.
            let none: [&HashSet<u64>; 0] = [];
            for excluded in [&sets[..], &none[..]] {
                let wider = Search { k: k.saturating_add(1), excluded, ..search };
                for known in [&earlier, &snapshot] {
                    let neighbors = known.search(&query, &wider).unwrap().neighbors;
                    let known = EarlierAnswer { revision: known.revision(), neighbors: &neighbors };
                    let found = search_overlaid(&snapshot, &overlays, Some(known), &query, &search);
                    prop_assert_eq!(&found.unwrap(), &truth);
                }
            }
        }
    }
}
