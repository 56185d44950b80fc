//! Searches for many neighbours among more points, with ties: the index keeps their candidates in another way.

use wayfold_index::{Forest, ForestOptions, KdTree, Search, Space};

use crate::common::{Shape, assert_same, brute_force, rng, states, table};

const ROWS: usize = 1500;

#[test]
fn many_neighbors_are_those_of_brute_force() {
    for text in ["R3", "R2*SO2", "SO3", "R3*SO3:0.15"] {
        let space: Space = text.parse().unwrap();
        for shape in [Shape::Uniform, Shape::Duplicates, Shape::Grid] {
            let mut rng = rng(ROWS as u64 ^ (shape as u64) << 16);
            let stored = states(&space, shape, ROWS, &mut rng);
            let points = table(&space, &stored);
            let mut forest = Forest::new(space.clone(), ForestOptions::for_space(&space));
            forest.apply(1, &points, &[]).unwrap();
            let tree = KdTree::new(space.clone(), points.clone(), 16).unwrap();
            let mut queries = stored[..2].to_vec();
            queries.extend(states(&space, Shape::Uniform, 2, &mut rng));
            for query in &queries {
                for k in [39, 40, 41, 100, 400, ROWS - 1] {
                    let search = Search::nearest_k(k);
                    let expected = brute_force(&space, points.iter(), query, &search);
                    let what = format!("{text} {shape:?} k={k} {query:?}");
                    assert_same(
                        &tree.search(query, &search).unwrap().neighbors,
                        &expected,
                        &what,
                    );
                    let answer = forest.search(query, &search).unwrap();
                    assert_same(&answer.neighbors, &expected, &what);
                }
            }
        }
    }
}
