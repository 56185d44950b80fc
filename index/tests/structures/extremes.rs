//! Bounds outside the range in which errors are relative, against brute force.

use wayfold_index::{
    Factor, Forest, ForestOptions, Group, KdTree, Kernels, Linear, Points, Search, Space, Term,
};

/// Compares a tree and a settled forest, with every kernel, with `Linear`.
fn compare(space: &Space, rows: &[Vec<f64>], query: &[f64], search: &Search<'_>) {
    let mut points = Points::new(space.coordinates());
    let mut linear = Linear::new(space.clone());
    for (id, row) in rows.iter().enumerate() {
        let mut row = row.clone();
        space.canonicalize(&mut row).unwrap();
        points.push(id as u64, 0, 1, &row);
    }
    points
        .iter()
        .for_each(|point| linear.insert(point).unwrap());
    let mut query = query.to_vec();
    space.canonicalize(&mut query).unwrap();
    let bits = |answer: wayfold_index::Answer| -> Vec<(u64, u64)> {
        answer
            .neighbors
            .iter()
            .map(|n| (n.id, n.distance.to_bits()))
            .collect()
    };
    let expected = bits(linear.search(&query, search).unwrap());
    let mut forest = Forest::new(
        space.clone(),
        ForestOptions {
            growing_rows: 4,
            leaf_rows: 2,
        },
    );
    forest.apply(1, &points, &[]).unwrap();
    forest.settle();
    let snapshot = forest.snapshot();
    for kernels in Kernels::available() {
        for leaf_rows in [1, 2, 16] {
            let tree = KdTree::new(space.clone(), points.clone(), leaf_rows).unwrap();
            let found = bits(tree.search_with(kernels, &query, search).unwrap());
            assert_eq!(
                found,
                expected,
                "{space:?} leaves of {leaf_rows} {}",
                kernels.name()
            );
        }
        let found = bits(snapshot.search_with(kernels, &query, search).unwrap());
        assert_eq!(found, expected, "{space:?} forest {}", kernels.name());
    }
}

/// A quaternion at distance `theta` from the identity.
fn about_x(theta: f64) -> [f64; 4] {
    [theta.sin(), 0.0, 0.0, theta.cos()]
}

/// Boxes infinitely far away have equal keys, and are within an infinite limit.
#[test]
fn boxes_infinitely_far_away_are_visited_once_each() {
    let space: Space = "R1:1e10".parse().unwrap();
    let mut rows: Vec<Vec<f64>> = (0..40).map(|i| vec![f64::from(i)]).collect();
    rows.extend((0..40).map(|i| vec![1e150 - 1e140 * f64::from(i)]));
    compare(&space, &rows, &[3.3], &Search::nearest_k(3));
    compare(&space, &rows, &[3.3], &Search::nearest_k(50));
    compare(&space, &rows, &[3.3], &Search::nearest_r(f64::INFINITY));
    compare(&space, &rows, &[3.3], &Search::nearest_r(1e300));
}

/// The weight of the last coordinate is infinite, and all points are equal in it.
#[test]
fn a_coordinate_of_infinite_weight_without_spread_hides_no_point() {
    let space: Space = "sum(R9,(R1:1e100):1e300)".parse().unwrap();
    let row = |at: u64| {
        let mut row: Vec<f64> = (1..=9_u64)
            .map(|axis| (at * axis * 37 % 1000) as f64 / 1e3)
            .collect();
        row.push(0.0);
        row
    };
    let rows: Vec<_> = (0..1000).map(row).collect();
    for search in [
        Search::nearest_k(1),
        Search::nearest_k(5),
        Search::nearest_r(0.5),
    ] {
        compare(&space, &rows, &row(3), &search);
    }
}

/// One rotation is far off (its bound is low by 0.7 %), and the translation of another point makes that point nearer by
/// less.
fn nearer_by_translation(space: &Space, unit: f64) {
    let half_pi = std::f64::consts::FRAC_PI_2;
    let mut far = vec![0.0];
    far.extend(about_x(half_pi));
    let mut near = vec![half_pi * unit * 0.998];
    near.extend(about_x(0.0));
    let mut query = vec![0.0];
    query.extend(about_x(0.0));
    compare(space, &[far, near], &query, &Search::nearest_k(1));
}

#[test]
fn a_small_weight_keeps_the_rest_of_the_series_in_one_group() {
    for exponent in [-55, -60, -62, -64, -66, -70, -75, -76, -77, -80] {
        let weight = 10f64.powi(exponent);
        let space = Space::product(vec![
            Term {
                factor: Factor::RealVector(1),
                weight: 1.0,
            },
            Term {
                factor: Factor::SO3,
                weight,
            },
        ])
        .unwrap();
        nearer_by_translation(&space, weight.sqrt());
    }
}

#[test]
fn a_small_weight_keeps_the_rest_of_the_series_in_a_sum() {
    for exponent in [-30, -34, -36, -37, -38, -39, -45] {
        let weight = 10f64.powi(exponent);
        let space: Space = format!("sum(R1, SO3:{weight:e})").parse().unwrap();
        nearer_by_translation(&space, weight);
    }
}

#[test]
fn a_group_far_heavier_than_its_rotation_keeps_the_rest_of_the_series() {
    let group = |factor, weight, mu| Group {
        weight,
        terms: vec![Term { factor, weight: mu }],
    };
    for (w, mu) in [
        (1e30, 1e-20),
        (1e38, 1e-20),
        (1e39, 1e-20),
        (1e45, 1e-60),
        (1e-41, 1e10),
    ] {
        let space = Space::new(vec![
            group(Factor::RealVector(1), 1.0, 1.0),
            group(Factor::SO3, w, mu),
        ])
        .unwrap();
        nearer_by_translation(&space, w * mu.sqrt());
    }
}

/// A rotation that weighs nothing leaves nothing to add to an infinite key, not a NaN. (They are one
/// leaf.)
#[test]
fn an_infinite_distance_with_a_weightless_rotation_displaces_no_neighbour() {
    let space: Space = "R1:1e10*SO3:0".parse().unwrap();
    let row = |x: f64| [&[x][..], &about_x(0.0)].concat();
    let mut points = Points::new(5);
    (0..16).for_each(|id| points.push(id, 0, 1, &row(1e150)));
    (16..32).for_each(|id| points.push(id, 0, 1, &row(id as f64)));
    let mut forest = Forest::new(
        space.clone(),
        ForestOptions {
            growing_rows: 128,
            leaf_rows: 16,
        },
    );
    let mut linear = Linear::new(space.clone());
    forest.apply(1, &points, &[]).unwrap();
    points
        .iter()
        .for_each(|point| linear.insert(point).unwrap());
    let search = Search::nearest_k(20);
    let expected = linear.search(&row(0.0), &search).unwrap().neighbors;
    assert_eq!(
        forest.search(&row(0.0), &search).unwrap().neighbors,
        expected
    );
}

/// Near rotations of a great weight, whose cosines tell them apart by no more than its slack.
#[test]
fn a_great_weight_within_a_group_of_a_sum_keeps_the_slack_of_the_cosine() {
    let term = |factor, weight| Term { factor, weight };
    for exponent in [70, 75, 76, 77, 78, 80, 100, 200] {
        let mu = 10f64.powi(exponent);
        let space = Space::new(vec![
            Group {
                weight: 1.0,
                terms: vec![term(Factor::RealVector(1), 1.0)],
            },
            Group {
                weight: 1.0,
                terms: vec![term(Factor::SO3, mu)],
            },
        ])
        .unwrap();
        let row = |x: f64, theta: f64| [&[x][..], &about_x(theta)].concat();
        // The cosines of the first points are 1, and the translation of the last is smaller than their distances.
        let unit = mu.sqrt();
        let rows = [row(0.0, 3e-9), row(0.0, 2e-9), row(1e-10 * unit, 0.0)];
        for k in 1..=3 {
            compare(&space, &rows, &row(0.0, 0.0), &Search::nearest_k(k));
        }
    }
}

/// Distances out of range are all equal: the least ids win, though their keys differ.
#[test]
fn the_least_ids_of_infinitely_distant_points_win() {
    let space = Space::new(vec![Group {
        weight: 1e250,
        terms: vec![Term {
            factor: Factor::RealVector(1),
            weight: 1.0,
        }],
    }])
    .unwrap();
    let rows: Vec<Vec<f64>> = (0..40)
        .map(|i| vec![1e100 * f64::from(40 - i)])
        .chain([vec![1.0]])
        .collect();
    for k in [1, 3, 20, 41] {
        compare(&space, &rows, &[0.0], &Search::nearest_k(k));
    }
}

/// In a sum of groups a rotation's squared angle may overflow where its lower bound does not.
#[test]
fn a_finite_distance_is_nearer_than_one_that_overflows() {
    let space: Space = "sum(R1, (SO3:7.31e307):1e-154)".parse().unwrap();
    let mut infinite = vec![0.0];
    infinite.extend(about_x(std::f64::consts::FRAC_PI_2));
    let finite = vec![2.0, 0.0, 0.0, 0.0, 1.0];
    let query = [0.0, 0.0, 0.0, 0.0, 1.0];
    assert_eq!(space.distance(&query, &infinite), f64::INFINITY);
    compare(&space, &[infinite, finite], &query, &Search::nearest_k(1));
}
