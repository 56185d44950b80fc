//! Every structure against brute force, in every space, on data that reaches the corners.

use std::collections::HashSet;

use crate::common::{
    SHAPES, SPACES, Shape, assert_same, brute_force, rng, searches, states, table,
};
use wayfold_index::{
    Answer, Forest, ForestOptions, KdTree, Kernels, Linear, Mpnn, Points, Search, Snapshot, Space,
    TreeReport,
};

const ROWS: usize = 150;
const QUERIES: usize = 12;

/// A structure under test, by name.
type Structure = (String, Box<dyn Fn(&[f64], &Search<'_>) -> Answer>);

fn structures(space: &Space, points: &Points) -> Vec<Structure> {
    let mut all: Vec<Structure> = Vec::new();

    let mut linear = Linear::new(space.clone());
    points
        .iter()
        .for_each(|point| linear.insert(point).unwrap());
    all.push((
        "linear".into(),
        Box::new(move |q, s| linear.search(q, s).unwrap()),
    ));

    for leaf_rows in [1, 2, 5, 1000] {
        let tree = KdTree::new(space.clone(), points.clone(), leaf_rows).unwrap();
        tree.validate().unwrap();
        for kernels in Kernels::available() {
            let tree = tree.clone();
            let name = format!("kdtree/{leaf_rows}/{}", kernels.name());
            all.push((
                name,
                Box::new(move |q, s| tree.search_with(kernels, q, s).unwrap()),
            ));
        }
    }

    for leaf_rows in [1, 2, 5, 1000] {
        let tree = Mpnn::new(space.clone(), points.clone(), leaf_rows).unwrap();
        tree.validate().unwrap();
        let name = format!("mpnn/{leaf_rows}");
        all.push((name, Box::new(move |q, s| tree.search(q, s).unwrap())));
    }

    for (growing_rows, leaf_rows) in [(1, 1), (4, 2), (7, 3), (1000, 4)] {
        let options = ForestOptions {
            growing_rows,
            leaf_rows,
        };
        for settled in [true, false] {
            let forest = grown(space, options, points, settled);
            let name = format!("forest/{growing_rows}/{leaf_rows}/{settled}");
            all.extend(with_every_kernel(&name, &forest.snapshot()));
        }
        let mut bulk = Forest::new(space.clone(), options);
        bulk.apply(1, points, &[]).unwrap();
        let unbuilt = bulk.snapshot();
        bulk.settle();
        bulk.validate().unwrap();
        all.push((
            format!("bulk/{growing_rows}"),
            Box::new(move |q, s| unbuilt.search(q, s).unwrap()),
        ));
        let name = format!("bulk, settled/{growing_rows}");
        all.push((name, Box::new(move |q, s| bulk.search(q, s).unwrap())));
    }
    all
}

/// A snapshot, searched with the kernels of each instruction set that this processor has.
fn with_every_kernel(name: &str, snapshot: &Snapshot) -> Vec<Structure> {
    let with = |kernels: &'static Kernels| -> Structure {
        let snapshot = snapshot.clone();
        let name = format!("{name}/{}", kernels.name());
        (
            name,
            Box::new(move |q, s| snapshot.search_with(kernels, q, s).unwrap()),
        )
    };
    Kernels::available().iter().map(with).collect()
}

/// One insert a revision, each twice where that replaces something, and a stray point that is removed again.
fn grown(space: &Space, options: ForestOptions, points: &Points, settled: bool) -> Forest {
    let mut forest = Forest::new(space.clone(), options);
    for (at, point) in points.iter().enumerate() {
        let revision = 3 * at as u64 + 1;
        let mut row = Points::new(space.coordinates());
        row.push(
            point.id,
            point.tag ^ 1,
            point.revision + 1,
            points.row(points.len() - 1),
        );
        row.push(u64::MAX / 2, point.tag, point.revision, point.row);
        forest.apply(revision, &row, &[]).unwrap();
        let mut row = Points::new(space.coordinates());
        row.push_point(point);
        forest.apply(revision + 1, &row, &[]).unwrap();
        assert_eq!(
            forest
                .apply(
                    revision + 2,
                    &Points::new(space.coordinates()),
                    &[u64::MAX / 2]
                )
                .unwrap(),
            1
        );
        if settled {
            forest.settle();
        }
    }
    forest.validate().unwrap();
    assert_eq!(forest.len(), points.len());
    forest
}

fn conforms(space_text: &str, shape: Shape) {
    let space: Space = space_text.parse().unwrap();
    let mut rng = rng(0x5EED ^ space_text.len() as u64 ^ ((shape as u64) << 8));
    let stored = states(&space, shape, ROWS, &mut rng);
    let points = table(&space, &stored);
    let structures = structures(&space, &points);

    // Stored states (distance 0, ties with duplicates), others like them, and ones unlike them.
    let mut queries = stored[..QUERIES / 3].to_vec();
    queries.extend(states(&space, shape, QUERIES / 3, &mut rng));
    queries.extend(states(&space, Shape::Uniform, QUERIES / 3, &mut rng));
    for query in &queries {
        let near = brute_force(&space, points.iter(), query, &Search::nearest_k(usize::MAX));
        let excluded: HashSet<u64> = near.iter().step_by(2).map(|neighbor| neighbor.id).collect();
        for (asked, search) in searches(&near, points.len(), &excluded) {
            let expected = brute_force(&space, points.iter(), query, &search);
            for (name, structure) in &structures {
                let what = format!("{space_text} {shape:?} {name} {asked} {query:?}");
                let answer = structure(query, &search);
                assert!(answer.exact, "{what}");
                assert_same(&answer.neighbors, &expected, &what);
            }
            for (name, structure) in &structures {
                approximate(query, &search, &expected, name, structure);
            }
        }
    }
}

/// What (1+ε) and a cap on leaves promise: nothing that is not stored, nothing farther than ε allows, and `exact`
/// only where brute force agrees.
fn approximate(
    query: &[f64],
    exact: &Search<'_>,
    expected: &[wayfold_index::Neighbor],
    name: &str,
    structure: &dyn Fn(&[f64], &Search<'_>) -> Answer,
) {
    let relaxed = Search {
        epsilon: 0.5,
        ..*exact
    };
    let answer = structure(query, &relaxed);
    if answer.exact {
        assert_same(&answer.neighbors, expected, name);
    }
    for (at, truth) in expected.iter().enumerate() {
        match answer.neighbors.get(at) {
            Some(found) => assert!(
                found.distance <= truth.distance * 1.5,
                "{name} {found:?} {truth:?}"
            ),
            // Only what lies near the rim of the ball may be missing.
            None => assert!(truth.distance * 1.5 > exact.radius, "{name} {truth:?}"),
        }
    }
    let capped = Search {
        max_leaves: 2,
        ..*exact
    };
    let answer = structure(query, &capped);
    if answer.exact {
        assert_same(&answer.neighbors, expected, name);
    }
    assert!(answer.neighbors.is_sorted() && answer.neighbors.len() <= expected.len());
}

/// Trees of two levels of nodes, grown and packed, answer as brute force does, both while searches descend and once they
/// have read so much of a tree that the next ones scan it.
fn splits_and_scans(space_text: &str) {
    let space: Space = space_text.parse().unwrap();
    let mut rng = rng(0x5CA4 ^ space_text.len() as u64);
    let points = table(&space, &states(&space, Shape::Uniform, ROWS, &mut rng));
    let queries = states(&space, Shape::Uniform, QUERIES, &mut rng);
    // Most of the points, and few enough for the tree to take note.
    let search = Search::nearest_k(ROWS * 3 / 5);
    let expected: Vec<_> = queries
        .iter()
        .map(|query| brute_force(&space, points.iter(), query, &search))
        .collect();
    let check = |name: &str, answer: &dyn Fn(&[f64]) -> Answer| {
        for (query, expected) in queries.iter().zip(&expected) {
            assert_same(
                &answer(query).neighbors,
                expected,
                &format!("{space_text} {name}"),
            );
        }
    };
    let is_reached = |report: TreeReport| report.height > 1 && report.scans > 0;

    let options = ForestOptions {
        growing_rows: 1000,
        leaf_rows: 4,
    };
    let mut forest = Forest::new(space.clone(), options);
    for (revision, point) in (1..).zip(points.iter()) {
        let mut row = Points::new(space.coordinates());
        row.push_point(point);
        forest.apply(revision, &row, &[]).unwrap();
    }
    check("growing", &|query| forest.search(query, &search).unwrap());
    let report = forest.validate().unwrap();
    assert!(is_reached(report.growing), "{space_text} {report:?}");

    forest.pause();
    while let Some(merge) = forest.begin_merge() {
        forest.finish_merge(merge.run());
    }
    check("packed", &|query| forest.search(query, &search).unwrap());
    let report = forest.validate().unwrap();
    assert!(report.levels.into_iter().all(is_reached), "{space_text}");
    assert_eq!(report.growing.height, 0, "{space_text}");

    for kernels in Kernels::available() {
        let tree = KdTree::new(space.clone(), points.clone(), 4).unwrap();
        check(kernels.name(), &|query| {
            tree.search_with(kernels, query, &search).unwrap()
        });
        assert!(is_reached(tree.validate().unwrap()), "{space_text}");
    }
}

/// Two tests a space, so that a failure names it and they run side by side.
macro_rules! conformance {
    ($($name:ident: $index:literal,)*) => {
        $(mod $name {
            use super::*;

            #[test]
            fn conforms() {
                for shape in SHAPES {
                    super::conforms(SPACES[$index], shape);
                }
            }

            #[test]
            fn splits_and_scans() {
                super::splits_and_scans(SPACES[$index]);
            }
        })*
        #[test]
        fn every_space_has_its_test() {
            assert_eq!([$($index),*].len(), SPACES.len());
        }
    };
}

conformance! {
    r1: 0,
    r3: 1,
    r6: 2,
    circle: 3,
    euler_angles: 4,
    six_circles: 5,
    rotations: 6,
    se2: 7,
    se3: 8,
    se3_heavy_rotation: 9,
    se3_as_a_sum: 10,
    torus_beside_r3: 11,
    seven_joints: 12,
    two_bodies: 13,
    eight_bodies: 14,
    zero_weight: 15,
    period_of_one: 16,
}

#[test]
fn an_empty_structure_answers_nothing() {
    for text in SPACES {
        let space: Space = text.parse().unwrap();
        let query = &states(&space, Shape::Uniform, 1, &mut rng(1))[0];
        for (name, structure) in structures(&space, &Points::new(space.coordinates())) {
            for search in [Search::nearest_k(3), Search::nearest_r(f64::INFINITY)] {
                let answer = structure(query, &search);
                assert!(answer.exact && answer.neighbors.is_empty(), "{text} {name}");
            }
        }
    }
}

/// The design's warning: without the weight in the incremental bound, μ = 0.15 prunes true neighbours. Large enough
/// that a wrong bound would show.
#[test]
fn weights_below_and_above_one_prune_nothing_true() {
    for text in [
        "R3*SO3:0.15",
        "R3*SO3:15",
        "R1:0.15*R1:15*SO2:0.15",
        "sum(R3:0.15, SO3:15)",
    ] {
        let space: Space = text.parse().unwrap();
        let mut rng = rng(15);
        let points = table(&space, &states(&space, Shape::Uniform, 4000, &mut rng));
        let tree = KdTree::new(space.clone(), points.clone(), 4).unwrap();
        let incremental = Mpnn::new(space.clone(), points.clone(), 4).unwrap();
        for query in states(&space, Shape::Uniform, 50, &mut rng) {
            let search = Search::nearest_k(10);
            let expected = brute_force(&space, points.iter(), &query, &search);
            for answer in [
                tree.search(&query, &search),
                incremental.search(&query, &search),
            ] {
                assert_same(&answer.unwrap().neighbors, &expected, text);
            }
        }
    }
}

/// Where squares and weights leave the range in which errors are relative, a bound must give way. The ball around a
/// state through a point is closed, so it holds that point.
#[test]
fn weights_at_the_ends_of_the_range_lose_no_point() {
    let texts = [
        "SO3:1.5386330166173383e-305",
        "SO3:1e-295",
        "SO3:5e-324",
        "R3:1e-307*SO3:1e-309",
        "sum(SO3:1e-308, R1:1e300)",
        "SO3:1e300",
        "SO2[1e-150]*SO3:1e-306",
    ];
    for text in texts {
        let space: Space = text.parse().unwrap();
        let mut rng = rng(305);
        let points = table(&space, &states(&space, Shape::Tiny, 200, &mut rng));
        let structures = structures(&space, &points);
        for query in states(&space, Shape::Tiny, 10, &mut rng) {
            for point in points.iter().step_by(7) {
                let search = Search::nearest_r(space.distance(&query, point.row));
                let expected = brute_force(&space, points.iter(), &query, &search);
                assert!(expected.iter().any(|neighbor| neighbor.id == point.id));
                for (name, structure) in &structures {
                    let answer = structure(&query, &search);
                    assert_same(&answer.neighbors, &expected, &format!("{text} {name}"));
                }
            }
        }
    }
}

/// A search that is out of time or of leaves stops, and says that it is not exact.
#[test]
fn a_search_that_gives_up_says_so() {
    let space = Space::se3();
    let mut rng = rng(7);
    let points = table(&space, &states(&space, Shape::Uniform, 20_000, &mut rng));
    let tree = KdTree::new(space.clone(), points.clone(), 8).unwrap();
    let binary = Mpnn::new(space.clone(), points, 8).unwrap();
    let query = &states(&space, Shape::Uniform, 1, &mut rng)[0];
    let all = Search::nearest_r(f64::INFINITY);
    let late = Search {
        until: Some(std::time::Instant::now()),
        ..all
    };
    let capped = Search {
        max_leaves: 3,
        ..all
    };
    let structures: [&dyn Fn(&Search<'_>) -> Answer; 2] =
        [&|search| tree.search(query, search).unwrap(), &|search| {
            binary.search(query, search).unwrap()
        }];
    for structure in structures {
        assert!(structure(&all).exact);
        let answer = structure(&late);
        let found = answer.neighbors.len();
        assert!(!answer.exact && found < 32 * 8 + 8, "{found}");
        let answer = structure(&capped);
        assert!(!answer.exact && answer.neighbors.len() <= 3 * 8);
    }
}

/// Where searches reach most of a tree, it is read from end to end instead: with the same answers.
#[test]
fn in_many_dimensions_answers_stay_the_same() {
    let space: Space = "(R3*SO3:0.15)^8".parse().unwrap();
    let mut rng = rng(8);
    let points = table(&space, &states(&space, Shape::Uniform, 3000, &mut rng));
    let tree = KdTree::new(space.clone(), points.clone(), 8).unwrap();
    for query in states(&space, Shape::Uniform, 150, &mut rng) {
        for search in [Search::nearest_k(1), Search::nearest_k(10)] {
            let expected = brute_force(&space, points.iter(), &query, &search);
            let answer = tree.search(&query, &search).unwrap();
            assert!(answer.exact);
            assert_same(&answer.neighbors, &expected, "eight bodies");
        }
    }
}

/// More than a search cares to hold are equally near: the least ids win.
#[test]
fn of_many_that_coincide_the_least_ids_are_told() {
    for text in ["R3", "SO3", "R3*SO3:0.15", "sum(R1, SO3)"] {
        let space: Space = text.parse().unwrap();
        let (mut query, mut state) = (
            vec![0.3; space.coordinates()],
            vec![0.5; space.coordinates()],
        );
        state[space.coordinates() - 1] = 0.4;
        let norm = |row: &mut [f64]| {
            let rotation = row.len().saturating_sub(4);
            let norm = row[rotation..].iter().map(|x| x * x).sum::<f64>().sqrt();
            row[rotation..].iter_mut().for_each(|x| *x /= norm);
        };
        if text != "R3" {
            norm(&mut query);
            norm(&mut state);
        }
        space.canonicalize(&mut query).unwrap();
        space.canonicalize(&mut state).unwrap();
        let mut points = Points::new(space.coordinates());
        // 7 and 2000 share no divisor: each id once, in no order.
        for id in (0..2000).map(|i| i * 7 % 2000) {
            points.push(id, 0, 1, &state);
        }
        let tree = KdTree::new(space.clone(), points, 16).unwrap();
        let distance = space.distance(&query, &state);
        for (k, radius) in [(1, f64::INFINITY), (20, distance), (300, f64::INFINITY)] {
            let search = Search {
                radius,
                ..Search::nearest_k(k)
            };
            for kernels in Kernels::available() {
                let answer = tree.search_with(kernels, &query, &search).unwrap();
                let ids: Vec<u64> = answer.neighbors.iter().map(|near| near.id).collect();
                assert_eq!(ids, (0..k as u64).collect::<Vec<_>>(), "{text} {k}");
                assert!(
                    answer
                        .neighbors
                        .iter()
                        .all(|near| near.distance == distance)
                );
            }
        }
    }
}
