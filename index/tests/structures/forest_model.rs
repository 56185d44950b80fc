//! Sequences of operations on a forest against a model: a map of points, searched by brute force.

use std::collections::BTreeMap;

use crate::common::{SPACES, Shape, assert_same, brute_force, rng, states};
use proptest::{prelude::*, test_runner::RngSeed};
use wayfold_index::{
    Forest, ForestOptions, ForestSnapshot, KdTree, Merged, Point, PointRef, Points, Search, Space,
};

/// A stored point of the model: tag, revision, row.
type Model = BTreeMap<u64, (u64, u64, Vec<f64>)>;

fn points_of(model: &Model) -> impl Iterator<Item = PointRef<'_>> {
    model.iter().map(|(&id, (tag, revision, row))| PointRef {
        id,
        tag: *tag,
        revision: *revision,
        row,
    })
}

#[derive(Clone, Debug)]
enum Op {
    /// Stores this many points under ids from a small range, so that many replace others.
    Store {
        rows: usize,
        first_id: u64,
    },
    /// Removes ids that may or may not be there, some twice.
    Remove {
        ids: Vec<u64>,
    },
    /// Stores and removes in one mutation.
    Both {
        ids: Vec<u64>,
        first_id: u64,
    },
    BeginMerge,
    RunMerge,
    FinishMerge,
    Settle,
    Hold,
    Release,
}

fn op() -> impl Strategy<Value = Op> {
    let ids = || prop::collection::vec(0..60u64, 0..25);
    prop_oneof![
        6 => (1..30usize, 0..50u64).prop_map(|(rows, first_id)| Op::Store { rows, first_id }),
        3 => ids().prop_map(|ids| Op::Remove { ids }),
        1 => (ids(), 0..50u64).prop_map(|(ids, first_id)| Op::Both { ids, first_id }),
        3 => Just(Op::BeginMerge),
        3 => Just(Op::RunMerge),
        3 => Just(Op::FinishMerge),
        1 => Just(Op::Settle),
        2 => Just(Op::Hold),
        1 => Just(Op::Release),
    ]
}

#[track_caller]
fn same_as_model(snapshot: &ForestSnapshot, model: &Model, query: &[f64]) {
    assert_eq!(snapshot.len(), model.len());
    let stored: Vec<Point> = points_of(model).map(PointRef::to_point).collect();
    assert_eq!(snapshot.points_after(None).collect::<Vec<_>>(), stored);
    let after: Vec<Point> = snapshot.points_after(Some(20)).collect();
    let above = stored.iter().filter(|point| point.id > 20);
    assert_eq!(after, above.cloned().collect::<Vec<_>>());
    for id in 0..80 {
        let expected = stored.iter().find(|point| point.id == id);
        assert_eq!(snapshot.get(id).as_ref(), expected);
    }
    let mut recent = Search::nearest_k(4);
    recent.filter.since_revision = snapshot.revision().saturating_sub(2);
    for search in [Search::nearest_k(5), Search::nearest_r(0.3), recent] {
        let expected = brute_force(snapshot.space(), points_of(model), query, &search);
        assert_same(
            &snapshot.search(query, &search).unwrap().neighbors,
            &expected,
            "snapshot",
        );
    }
}

fn run(space: &Space, options: ForestOptions, ops: Vec<Op>, seed: u64) {
    let mut rng = rng(seed);
    let mut forest = Forest::new(space.clone(), options);
    let mut model = Model::new();
    let mut begun = Vec::new();
    let mut ran: Vec<Merged> = Vec::new();
    let mut held: Vec<(ForestSnapshot, Model)> = Vec::new();
    for op in ops {
        let revision = forest.revision() + 1;
        let mut store = |model: &mut Model, rows: usize, first_id: u64| {
            let mut points = Points::new(space.coordinates());
            let shape = if rows.is_multiple_of(2) {
                Shape::Uniform
            } else {
                Shape::Grid
            };
            for (id, row) in (first_id..).zip(states(space, shape, rows, &mut rng)) {
                points.push(id, id % 4, revision, &row);
                model.insert(id, (id % 4, revision, row));
            }
            points
        };
        let remove = |model: &mut Model, ids: &[u64]| {
            ids.iter().filter(|&id| model.remove(id).is_some()).count()
        };
        match op {
            Op::Store { rows, first_id } => {
                let points = store(&mut model, rows, first_id);
                forest.apply(revision, &points, &[]).unwrap();
            }
            Op::Remove { ids } => {
                let removed = remove(&mut model, &ids);
                let none = Points::new(space.coordinates());
                assert_eq!(forest.apply(revision, &none, &ids).unwrap(), removed);
            }
            Op::Both { ids, first_id } => {
                let removed = remove(&mut model, &ids);
                let points = store(&mut model, 5, first_id);
                assert_eq!(forest.apply(revision, &points, &ids).unwrap(), removed);
            }
            Op::BeginMerge => begun.extend(forest.begin_merge()),
            Op::RunMerge => ran.extend(begun.pop().map(|merge| merge.run())),
            Op::FinishMerge => {
                if !ran.is_empty() {
                    forest.finish_merge(ran.remove(0));
                }
            }
            Op::Settle => forest.settle(),
            Op::Hold => held.push((forest.snapshot(), model.clone())),
            Op::Release => {
                held.pop();
            }
        }
        forest.validate().unwrap();
        let query = &states(space, Shape::Uniform, 1, &mut rng)[0];
        same_as_model(&forest.snapshot(), &model, query);
        for (snapshot, then) in &held {
            same_as_model(snapshot, then, query);
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig {
        cases: 300,
        rng_seed: RngSeed::Fixed(48),
        failure_persistence: None,
        ..ProptestConfig::default()
    })]

    /// Every held revision stays unchanged, whatever mutations follow.
    #[test]
    fn a_forest_is_its_model(
        space in 0..SPACES.len(),
        growing_rows in prop_oneof![1..20usize, 100..400usize],
        leaf_rows in 1..6usize,
        ops in prop::collection::vec(op(), 1..40),
        seed: u64,
    ) {
        let space = SPACES[space].parse().unwrap();
        run(&space, ForestOptions { growing_rows, leaf_rows }, ops, seed);
    }
}

/// Merges free the memory of removed points.
#[test]
fn memory_of_removed_points_comes_back() {
    let space = Space::se3();
    let mut forest = Forest::new(space.clone(), ForestOptions::for_space(&space));
    let empty = forest.memory_bytes();
    let mut points = Points::new(space.coordinates());
    for (id, row) in states(&space, Shape::Uniform, 20_000, &mut rng(3))
        .iter()
        .enumerate()
    {
        points.push(id as u64, 0, 1, row);
    }
    forest.apply(1, &points, &[]).unwrap();
    forest.settle();
    let full = forest.memory_bytes();
    // At rest, at most 1.5 times the states, ids, tags and revisions.
    let stored = 20_000 * 8 * (space.coordinates() + 3);
    assert!(2 * (full - empty) < 3 * stored, "{full} for {stored}");
    let none = Points::new(space.coordinates());
    forest
        .apply(2, &none, &(0..19_000).collect::<Vec<_>>())
        .unwrap();
    forest.settle();
    assert!(
        forest.memory_bytes() < full / 15,
        "{} of {full}",
        forest.memory_bytes()
    );
    forest
        .apply(3, &none, &(19_000..20_000).collect::<Vec<_>>())
        .unwrap();
    forest.settle();
    assert!(forest.is_empty() && forest.memory_bytes() <= empty + 64 * 1024);
    forest.validate().unwrap();
}

/// Reading all points, one by one and in order, leaves nothing behind in memory.
#[test]
fn a_full_scan_leaves_nothing_behind() {
    let space = Space::se3();
    let rows = states(&space, Shape::Uniform, 5000, &mut rng(9));
    let mut points = Points::new(space.coordinates());
    for (id, row) in (0..).zip(&rows) {
        points.push(id, 0, 1, row);
    }
    let tree = KdTree::new(space.clone(), points.clone(), 16).unwrap();
    let options = ForestOptions::for_space(&space);
    let mut forest = Forest::new(space, options);
    forest.apply(1, &points, &[]).unwrap();
    forest.settle();
    let held = forest.memory_bytes();
    assert!(
        forest
            .snapshot()
            .points_after(None)
            .eq(points.iter().map(PointRef::to_point))
    );
    for point in tree.iter() {
        assert_eq!(forest.get(point.id), Some(point));
    }
    assert_eq!(forest.memory_bytes(), held);
}

/// An idle forest merges until one tree is left, including points that were inserted singly.
#[test]
fn merges_end_in_one_level() {
    let space: Space = "R2".parse().unwrap();
    let options = ForestOptions {
        growing_rows: 4,
        leaf_rows: 2,
    };
    let mut forest = Forest::new(space.clone(), options);
    let row = |id: u64| vec![(id % 31) as f64, (id % 17) as f64];
    let mut merges = 0;
    for id in 1..=1024u64 {
        let mut points = Points::new(2);
        points.push(id, 0, id, &row(id));
        forest.apply(id, &points, &[]).unwrap();
        if let Some(merge) = forest.begin_merge() {
            forest.finish_merge(merge.run());
        }
    }
    while let Some(merge) = forest.begin_merge() {
        forest.finish_merge(merge.run());
        forest.validate().unwrap();
        merges += 1;
    }
    assert!((1..12).contains(&merges), "{merges}");
    // One tree has this many leaves.
    let all = Search::nearest_r(f64::INFINITY);
    let leaves = forest.snapshot().leaves_visited(&[0.0; 2], &all).unwrap();
    assert!(leaves <= 1024 / 2, "{leaves}");
}

/// Readers on other threads see whole revisions while the owner writes and merges.
#[test]
fn snapshots_are_never_torn() {
    let space: Space = "R2".parse().unwrap();
    let options = ForestOptions {
        growing_rows: 8,
        leaf_rows: 2,
    };
    let mut forest = Forest::new(space.clone(), options);
    let (sender, receiver) = std::sync::mpsc::sync_channel::<ForestSnapshot>(4);
    let reader = std::thread::spawn(move || {
        let mut seen = 0;
        for snapshot in receiver {
            // Revision r stores point r and moves point 0 to r, so both are at one place and no point is beyond it.
            let revision = snapshot.revision();
            let at = [revision as f64, 0.0];
            for _ in 0..20 {
                let answer = snapshot.search(&at, &Search::nearest_r(0.5)).unwrap();
                let ids: Vec<u64> = answer.neighbors.iter().map(|n| n.id).collect();
                assert_eq!(ids, [0, revision]);
                assert_eq!(snapshot.len() as u64, revision + 1);
            }
            seen += 1;
        }
        seen
    });
    for revision in 1..=2000u64 {
        let row = [revision as f64, 0.0];
        let mut points = Points::new(2);
        points.push(0, 0, revision, &row);
        points.push(revision, 0, revision, &row);
        forest.apply(revision, &points, &[]).unwrap();
        sender.send(forest.snapshot()).unwrap();
        if revision.is_multiple_of(3) {
            forest.settle();
        }
    }
    drop(sender);
    assert_eq!(reader.join().unwrap(), 2000);
    forest.validate().unwrap();
}

/// The result of another forest's merge changes nothing.
#[test]
fn a_forest_takes_only_its_own_merges() {
    let space: Space = "R1".parse().unwrap();
    let options = ForestOptions {
        growing_rows: 16,
        leaf_rows: 16,
    };
    let forest = |first_id: u64| {
        let mut forest = Forest::new(space.clone(), options);
        for revision in 1..=2 {
            let mut points = Points::new(1);
            let ids = first_id + 100 * revision..first_id + 100 * revision + 10;
            ids.for_each(|id| points.push(id, 0, revision, &[id as f64]));
            forest.apply(revision, &points, &[]).unwrap();
        }
        forest
    };
    let (mut one, mut other) = (forest(1_000), forest(5_000));
    let (merge, others) = (one.begin_merge().unwrap(), other.begin_merge().unwrap());
    one.finish_merge(others.run());
    one.validate().unwrap();
    let nearest = one.search(&[0.0], &Search::nearest_k(1)).unwrap();
    assert_eq!(nearest.neighbors[0].id, 1_100);
    one.finish_merge(merge.run());
    one.validate().unwrap();
    assert_eq!(one.len(), 20);
}
