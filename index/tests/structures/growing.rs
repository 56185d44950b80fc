//! The tree that grows by single points: points in a bad order, searches for new points, points that are written over
//! and over, and pauses.

use std::time::Instant;

use crate::common::{Shape, assert_same, brute_force, rng, states};
use wayfold_index::{Filter, Forest, ForestOptions, PointRef, Points, Search, SearchError, Space};

/// Inserts rows one by one, each a mutation of its own, from id and revision 1 on; validates now and then.
fn grow(space: &Space, rows: &[Vec<f64>]) -> Forest {
    let mut forest = Forest::new(space.clone(), ForestOptions::for_space(space));
    for (revision, row) in (1..).zip(rows) {
        insert(&mut forest, revision, row);
        if revision % 500 == 0 {
            forest.validate().unwrap();
        }
    }
    forest.validate().unwrap();
    forest
}

fn leaves_visited(forest: &Forest, state: &[f64], search: &Search<'_>) -> usize {
    forest.snapshot().leaves_visited(state, search).unwrap()
}

fn insert(forest: &mut Forest, id: u64, row: &[f64]) {
    let revision = forest.revision() + 1;
    let mut point = Points::new(row.len());
    point.push(id, id % 3, revision, row);
    forest.apply(revision, &point, &[]).unwrap();
    forest.settle();
}

/// Sorted, coinciding, clustered points: searches are exact, and visit no more than a part of the leaves.
#[test]
fn no_order_of_points_makes_searches_long() {
    let space = Space::se2();
    let shapes = [
        Shape::Uniform,
        Shape::Collinear,
        Shape::Grid,
        Shape::Duplicates,
        Shape::Clustered,
        Shape::Geometric,
    ];
    for shape in shapes {
        let rows = states(&space, shape, 3000, &mut rng(7));
        let forest = grow(&space, &rows);
        let mut points = Points::new(3);
        for (id, row) in (1..).zip(&rows) {
            points.push(id, id % 3, id, row);
        }
        for query in states(&space, Shape::Uniform, 20, &mut rng(8)) {
            let search = Search::nearest_k(5);
            let expected = brute_force(&space, points.iter(), &query, &search);
            let answer = forest.search(&query, &search).unwrap();
            assert_same(&answer.neighbors, &expected, "grown");
            // Boxes cannot separate many points that are about equally near.
            let ties = !matches!(shape, Shape::Uniform | Shape::Collinear);
            let leaves = leaves_visited(&forest, &query, &search);
            assert!(ties || leaves <= 60, "{shape:?} {leaves}");
        }
    }
}

/// A search for new points visits the leaves of new points, in a forest of any size.
#[test]
fn a_search_of_the_newest_visits_their_leaves_only() {
    let space = Space::se3();
    let rows = states(&space, Shape::Uniform, 5000, &mut rng(11));
    let forest = grow(&space, &rows);
    let newest = Search {
        filter: Filter {
            since_revision: 4997,
            ..Filter::default()
        },
        ..Search::nearest_k(10)
    };
    let answer = forest.search(&rows[0], &newest).unwrap();
    // The forest has about 500 leaves. (When a leaf is split, either part counts as new.)
    assert!(leaves_visited(&forest, &rows[0], &newest) <= 6);
    let mut ids: Vec<u64> = answer.neighbors.iter().map(|found| found.id).collect();
    ids.sort_unstable();
    assert_eq!(ids, [4998, 4999, 5000]);
}

/// A few points that move all the time leave no long history behind.
#[test]
fn points_that_are_written_over_and_over_stay_few() {
    let space = Space::se3();
    let rows = states(&space, Shape::Uniform, 20_000, &mut rng(13));
    let mut forest = Forest::new(space.clone(), ForestOptions::for_space(&space));
    for (at, row) in (0..).zip(&rows) {
        insert(&mut forest, at % 20, row);
    }
    forest.validate().unwrap();
    assert_eq!(forest.len(), 20);
    let search = Search::nearest_k(20);
    let answer = forest.search(&rows[0], &search).unwrap();
    // The leaves of these points and of at most 128 dead ones.
    assert!(leaves_visited(&forest, &rows[0], &search) <= 50);
    assert_eq!(answer.neighbors.len(), 20);
    assert!(forest.memory_bytes() < 1 << 20, "{}", forest.memory_bytes());
}

/// A few moving points among many resting ones leave no long history and little memory behind.
#[test]
fn moving_points_among_resting_ones_stay_quick_to_search() {
    let space: Space = "R3".parse().unwrap();
    let far: Vec<Vec<f64>> = states(&space, Shape::Uniform, 3000, &mut rng(23))
        .into_iter()
        .map(|row| row.iter().map(|x| x + 100.0).collect())
        .collect();
    let mut forest = grow(&space, &far);
    let moving = states(&space, Shape::Uniform, 2500, &mut rng(29));
    for (at, row) in (0..).zip(&moving) {
        insert(&mut forest, 10_000 + at % 20, row);
    }
    forest.validate().unwrap();
    let search = Search::nearest_k(10);
    let answer = forest.search(&moving[0], &search).unwrap();
    assert!(leaves_visited(&forest, &moving[0], &search) <= 8);
    assert!(answer.neighbors.iter().all(|found| found.id >= 10_000));
}

/// A deadline that has passed also ends a search that reads points in the order of their insertion.
#[test]
fn a_search_without_boxes_ends_in_time() {
    let space: Space = "R30".parse().unwrap();
    let rows = states(&space, Shape::Uniform, 3000, &mut rng(31));
    let forest = grow(&space, &rows);
    let late = Search {
        until: Some(Instant::now()),
        ..Search::nearest_k(1)
    };
    // Searches that reach most leaves make the next ones skip the boxes.
    for query in states(&space, Shape::Uniform, 20, &mut rng(37)) {
        forest.search(&query, &Search::nearest_k(1)).unwrap();
    }
    let query = &states(&space, Shape::Uniform, 1, &mut rng(41))[0];
    let scans = || forest.validate().unwrap().growing.scans;
    let before = scans();
    assert_eq!(forest.search(query, &late), Err(SearchError::TimedOut));
    assert_eq!(scans(), before + 1);
}

/// Writes that pause leave one packed tree, whether or not a merge was due before.
#[test]
fn grown_trees_are_packed_when_writes_pause() {
    let space = Space::se3();
    let rows = states(&space, Shape::Uniform, 6000, &mut rng(17));
    let mut forest = grow(&space, &rows);
    let grown = forest.memory_bytes();
    assert!(forest.begin_merge().is_none());
    assert_eq!(forest.snapshot().unpacked(), 0);
    assert_eq!(forest.snapshot().unpacked_since(), None);
    forest.pause();
    let merge = forest.begin_merge().unwrap();
    assert_eq!(forest.snapshot().unpacked(), rows.len());
    let since = forest.snapshot().unpacked_since();
    assert!(since.is_some());
    forest.apply(6001, &Points::new(7), &[5]).unwrap();
    assert_eq!(forest.snapshot().unpacked(), rows.len() - 1);
    insert(&mut forest, 5, &rows[4]);
    // It waits until the merge is swapped in.
    assert_eq!(forest.snapshot().unpacked_since(), since);
    forest.finish_merge(merge.run());
    assert_eq!(forest.snapshot().unpacked(), 0);
    assert_eq!(forest.snapshot().unpacked_since(), None);
    assert!(forest.begin_merge().is_none());
    let stored = rows.len() * 8 * (forest.space().coordinates() + 3);
    assert!(forest.memory_bytes() < grown);
    assert!(2 * forest.memory_bytes() < 3 * stored);
    forest.validate().unwrap();
    // The next mutation ends the pause.
    insert(&mut forest, 7000, &rows[0]);
    assert!(forest.begin_merge().is_none());
    assert_eq!(forest.len(), 6001);
}

/// A snapshot stays the same while its tree grows, splits, is sealed and packed.
#[test]
fn snapshots_of_a_growing_tree_stay_unchanged() {
    let space: Space = "R2*SO2".parse().unwrap();
    let options = ForestOptions {
        growing_rows: 700,
        leaf_rows: 4,
    };
    let mut forest = Forest::new(space.clone(), options);
    let rows = states(&space, Shape::Uniform, 2000, &mut rng(19));
    let mut held = Vec::new();
    for (id, row) in (1..).zip(&rows) {
        insert(&mut forest, id, row);
        if id % 90 == 0 {
            held.push(forest.snapshot());
        }
    }
    for snapshot in held {
        let mut points = Points::new(3);
        for (id, row) in (1..=snapshot.revision()).zip(&rows) {
            points.push(id, id % 3, id, row);
        }
        assert!(
            snapshot
                .points_after(None)
                .eq(points.iter().map(PointRef::to_point))
        );
        for query in &rows[1990..] {
            let search = Search::nearest_k(7);
            let expected = brute_force(&space, points.iter(), query, &search);
            assert_same(
                &snapshot.search(query, &search).unwrap().neighbors,
                &expected,
                "held",
            );
        }
    }
}

/// A forest that gets its points in parts, also without merges between them, equals one that gets them at once.
#[test]
fn points_can_be_loaded_in_parts() {
    let space = Space::se2();
    let rows = states(&space, Shape::Uniform, 3000, &mut rng(5));
    let mut points = Points::new(space.coordinates());
    let mut loaded = Forest::new(space.clone(), ForestOptions::for_space(&space));
    for (id, row) in (0..).zip(&rows) {
        points.push(id, id % 3, 1 + id % 7, row);
        if points.len() == 1000 {
            loaded.load(&points).unwrap();
            points = Points::new(space.coordinates());
        }
    }
    loaded.apply(7, &points, &[]).unwrap();
    loaded.settle_up_to(|| 1500);
    loaded.validate().unwrap();
    assert_eq!((loaded.len(), loaded.revision()), (3000, 7));
    let search = Search::nearest_k(10);
    let ask = |forest: &Forest| -> Vec<_> {
        let found = rows.iter().step_by(100);
        found
            .map(|row| forest.search(row, &search).unwrap().neighbors)
            .collect()
    };
    let in_parts = ask(&loaded);
    loaded.settle();
    assert_eq!(ask(&loaded), in_parts);
    let mut whole = Points::new(space.coordinates());
    for (id, row) in (0..).zip(&rows) {
        whole.push(id, id % 3, 1 + id % 7, row);
    }
    let mut forest = Forest::new(space.clone(), ForestOptions::for_space(&space));
    forest.apply(7, &whole, &[]).unwrap();
    forest.settle();
    assert_eq!(ask(&forest), in_parts);
    // Points of another width are refused.
    assert!(loaded.load(&Points::new(1)).is_err());
}
