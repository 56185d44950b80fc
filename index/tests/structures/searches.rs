//! Searches that meet special cases of the trees: splits and scans, weights, deadlines, and ties.

use crate::{
    common::{Shape, assert_same, brute_force, rng, states, table},
    conformance::{QUERIES, ROWS, structures},
};
use wayfold_index::{
    Answer, Forest, ForestOptions, KdTree, Kernels, Mpnn, Points, Search, SearchError, Space,
    TreeReport,
};

/// Trees of two levels of nodes, grown and packed, answer as brute force does, both while searches descend and once
/// they have read so much of a tree that the next ones scan it.
pub(crate) fn splits_and_scans(space_text: &str) {
    let space: Space = space_text.parse().unwrap();
    let mut rng = rng(0x5CA4 ^ space_text.len() as u64);
    let points = table(&space, &states(&space, Shape::Uniform, ROWS, &mut rng));
    let queries = states(&space, Shape::Uniform, QUERIES, &mut rng);
    // The search reads most of the points, and the tree is small enough to record it.
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

/// The design's warning: without the weight in the incremental bound, μ = 0.15 prunes true neighbours. The data is
/// large enough that a wrong bound would show.
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

/// Bounds stay valid where squares and weights leave the range in which errors are relative. The ball around a state
/// through a point is closed, so it holds that point.
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

/// A search that is out of time fails. One that visits fewer leaves than lie between two reads of the clock answers.
#[test]
fn a_search_that_is_out_of_time_fails() {
    let space = Space::se3();
    let mut rng = rng(7);
    let points = table(&space, &states(&space, Shape::Uniform, 20_000, &mut rng));
    let tree = KdTree::new(space.clone(), points.clone(), 8).unwrap();
    let binary = Mpnn::new(space.clone(), points.clone(), 8).unwrap();
    // No merge has packed these points.
    let mut loaded = Forest::new(space.clone(), ForestOptions::for_space(&space));
    loaded.load(&points).unwrap();
    let query = &states(&space, Shape::Uniform, 1, &mut rng)[0];
    let all = Search::nearest_r(f64::INFINITY);
    let late = Search {
        until: Some(std::time::Instant::now()),
        ..all
    };
    let short = Search {
        radius: 0.0,
        ..late
    };
    type Searched = Result<Answer, SearchError>;
    let structures: [&dyn Fn(&Search<'_>) -> Searched; 2] =
        [&|search| tree.search(query, search), &|search| {
            binary.search(query, search)
        }];
    for structure in structures {
        assert_eq!(structure(&all).unwrap().neighbors.len(), 20_000);
        assert_eq!(structure(&late), Err(SearchError::TimedOut));
        assert!(structure(&short).unwrap().neighbors.is_empty());
    }
    assert_eq!(loaded.search(query, &all).unwrap().neighbors.len(), 20_000);
    assert_eq!(loaded.search(query, &late), Err(SearchError::TimedOut));
}

/// A tree of which searches reach most is scanned from end to end, with the same answers.
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
            assert_same(&answer.neighbors, &expected, "eight bodies");
        }
    }
    assert!(tree.validate().unwrap().scans > 0);
}

/// Rows that are measured alone and blocks of rows share a buffer. A build with debug assertions panics if a position
/// of 1e6 is left in the column of a rotation.
#[test]
fn a_row_measured_alone_leaves_nothing_to_a_block() {
    let space: Space = "SO3*R1".parse().unwrap();
    let mut points = Points::new(space.coordinates());
    // Once 256 points are undecided, 257 candidates are measured, the last one alone; three more come after them.
    for id in 0..260 {
        points.push(id, 0, 1, &[0.0, 0.0, 0.0, 1.0, 1e6]);
    }
    let tree = KdTree::new(space, points, 16).unwrap();
    for kernels in Kernels::available() {
        let query = [0.0, 0.0, 0.0, 1.0, 1e6 + 3.0];
        let answer = tree.search_with(kernels, &query, &Search::nearest_k(1));
        let neighbors = answer.unwrap().neighbors;
        assert_eq!((neighbors[0].id, neighbors[0].distance), (0, 3.0));
    }
}

/// If more points are equally near than a search returns, the least ids win.
#[test]
fn the_least_ids_of_coinciding_points_win() {
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

/// The square of 1/(1 + epsilon) is below the least number.
#[test]
fn the_greatest_epsilon_finds_neighbours() {
    for space_text in ["R2", "sum(R2, SO3)"] {
        let space: Space = space_text.parse().unwrap();
        let points = table(&space, &states(&space, Shape::Uniform, 1000, &mut rng(77)));
        let tree = KdTree::new(space, points.clone(), 8).unwrap();
        let search = Search {
            epsilon: f64::MAX,
            ..Search::nearest_k(3)
        };
        let answer = tree.search(points.row(0), &search).unwrap();
        assert_eq!(answer.neighbors.len(), 3, "{space_text}");
    }
}
