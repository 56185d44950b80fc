//! Every structure against brute force, in every space, on data with extreme cases.

use std::collections::HashSet;

use crate::common::{
    SHAPES, SPACES, Shape, assert_same, brute_force, rng, searches, states, table,
};
use wayfold_index::{
    Answer, Forest, ForestOptions, ForestSnapshot, KdTree, Kernels, Linear, Mpnn, Points, Search,
    Space,
};

pub(crate) const ROWS: usize = 150;
pub(crate) const QUERIES: usize = 12;

/// A structure under test, by name.
pub(crate) type Structure = (String, Box<dyn Fn(&[f64], &Search<'_>) -> Answer>);

pub(crate) fn structures(space: &Space, points: &Points) -> Vec<Structure> {
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
        let unpacked = bulk.snapshot();
        bulk.settle();
        bulk.validate().unwrap();
        all.push((
            format!("bulk/{growing_rows}"),
            Box::new(move |q, s| unpacked.search(q, s).unwrap()),
        ));
        let name = format!("bulk, settled/{growing_rows}");
        all.push((name, Box::new(move |q, s| bulk.search(q, s).unwrap())));
    }
    all
}

/// A snapshot, searched with the kernels of each instruction set that this processor has.
fn with_every_kernel(name: &str, snapshot: &ForestSnapshot) -> Vec<Structure> {
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

/// One insert a revision, each made twice where it replaces a point, and a stray point that is removed again.
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
        for (search_name, search) in searches(&near, points.len(), &[&excluded]) {
            let expected = brute_force(&space, points.iter(), query, &search);
            for (name, structure) in &structures {
                let what = format!("{space_text} {shape:?} {name} {search_name} {query:?}");
                let answer = structure(query, &search);
                assert_same(&answer.neighbors, &expected, &what);
            }
            for (name, structure) in &structures {
                approximate(query, &search, &expected, name, structure);
            }
        }
    }
}

/// The promise of (1+ε): no neighbour is farther than ε allows.
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
    for (at, truth) in expected.iter().enumerate() {
        match answer.neighbors.get(at) {
            Some(found) => assert!(
                found.distance <= truth.distance * 1.5,
                "{name} {found:?} {truth:?}"
            ),
            // Only points near the surface of the ball may be missing.
            None => assert!(truth.distance * 1.5 > exact.radius, "{name} {truth:?}"),
        }
    }
    assert!(answer.neighbors.is_sorted() && answer.neighbors.len() <= expected.len());
}

/// Two tests a space, so that a failure names the space and the tests run in parallel.
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
                crate::searches::splits_and_scans(SPACES[$index]);
            }
        })*
        #[test]
        fn every_space_has_its_test() {
            assert!([$($index),*].into_iter().eq(0..SPACES.len()));
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
                assert!(answer.neighbors.is_empty(), "{text} {name}");
            }
        }
    }
}
