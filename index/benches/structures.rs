//! Times of the index alone at 50,000 points: building a tree, growing a forest by single inserts, and searching both
//! (for the nearest, for ten, and within a radius that holds about ten).
//!
//! Coordinates are uniform in [0, 1), angles and rotations uniform. Times of one machine do not carry to another:
//! compare rows of one run.

use std::hint::black_box;

use criterion::{BatchSize, BenchmarkId, Criterion, criterion_group, criterion_main};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use wayfold_index::{Factor, Forest, ForestOptions, KdTree, Points, Search, Space};

const POINTS: usize = 50_000;
const SPACES: [&str; 12] = [
    "R3",
    "R6",
    "R12",
    "SO2^3",
    "SO2^6",
    "SO3",
    "R2*SO2",
    "R3*SO3:0.15",
    "sum(R3, SO3)",
    "(R3*SO3:0.15)^2",
    "(R3*SO3:0.15)^4",
    "(R3*SO3:0.15)^8",
];

fn uniform(space: &Space, rows: usize, rng: &mut ChaCha8Rng) -> Vec<Vec<f64>> {
    let mut row = || {
        let mut row = Vec::new();
        for term in space.groups().iter().flat_map(|group| &group.terms) {
            match term.factor {
                Factor::RealVector(n) => row.extend((0..n).map(|_| rng.random::<f64>())),
                Factor::SO2 { period } => row.push((rng.random::<f64>() - 0.5) * period),
                Factor::SO3 => row.extend(rotation(rng)),
            }
        }
        space.canonicalize(&mut row).expect("a valid state");
        row
    };
    (0..rows).map(|_| row()).collect()
}

fn rotation(rng: &mut ChaCha8Rng) -> [f64; 4] {
    loop {
        let q: [f64; 4] = std::array::from_fn(|_| rng.random_range(-1.0..1.0));
        let norm_2: f64 = q.iter().map(|x| x * x).sum();
        if (0.01..=1.0).contains(&norm_2) {
            return q.map(|x| x / norm_2.sqrt());
        }
    }
}

fn table(space: &Space, rows: &[Vec<f64>]) -> Points {
    let mut points = Points::with_capacity(space.coordinates(), rows.len());
    for (id, row) in rows.iter().enumerate() {
        points.push(id as u64, 0, 1, row);
    }
    points
}

/// The median distance of the tenth neighbour over some queries.
fn tenth_nearest(tree: &KdTree, queries: &[Vec<f64>]) -> f64 {
    let tenth = |query: &Vec<f64>| {
        tree.search(query, &Search::nearest_k(10))
            .expect("points and states of the space")
            .neighbors[9]
            .distance
    };
    let mut distances: Vec<f64> = queries.iter().take(99).map(tenth).collect();
    distances.sort_by(f64::total_cmp);
    distances[distances.len() / 2]
}

/// A forest after single inserts, each followed by the merges that were due.
fn grown(space: &Space, rows: &[Vec<f64>]) -> Forest {
    let mut forest = Forest::new(space.clone(), ForestOptions::for_space(space));
    for (id, row) in rows.iter().enumerate() {
        let mut point = Points::with_capacity(space.coordinates(), 1);
        point.push(id as u64, 0, 1, row);
        forest
            .apply(id as u64 + 1, &point, &[])
            .expect("points and states of the space");
        forest.settle();
    }
    forest
}

fn structures(criterion: &mut Criterion) {
    for text in SPACES {
        let space: Space = text.parse().expect("a valid space");
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let rows = uniform(&space, POINTS, &mut rng);
        let queries = uniform(&space, 1000, &mut rng);

        let mut group = criterion.benchmark_group(text);
        group.sample_size(10);
        group.bench_function("grow by single inserts", |bencher| {
            bencher.iter(|| grown(&space, &rows));
        });
        group.bench_function("build", |bencher| {
            bencher.iter_batched(
                || table(&space, &rows),
                |points| {
                    KdTree::new(space.clone(), points, 16).expect("points and states of the space")
                },
                BatchSize::LargeInput,
            );
        });
        let forest = grown(&space, &rows);
        let rest = KdTree::new(space.clone(), table(&space, &rows), 16)
            .expect("points and states of the space");
        let mut searches = vec![("1", Search::nearest_k(1)), ("10", Search::nearest_k(10))];
        let radius = tenth_nearest(&rest, &queries);
        searches.push(("radius", Search::nearest_r(radius)));
        for (name, search) in &searches {
            let mut next = queries.iter().cycle();
            group.bench_function(BenchmarkId::new("forest", name), |bencher| {
                bencher.iter(|| {
                    let query = next.next().expect("a cycle does not end");
                    black_box(
                        forest
                            .search(query, search)
                            .expect("points and states of the space"),
                    )
                });
            });
            group.bench_function(BenchmarkId::new("tree", name), |bencher| {
                bencher.iter(|| {
                    let query = next.next().expect("a cycle does not end");
                    black_box(
                        rest.search(query, search)
                            .expect("points and states of the space"),
                    )
                });
            });
        }
        group.finish();
    }
}

criterion_group!(benches, structures);
criterion_main!(benches);
