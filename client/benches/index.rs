//! `Index::in_memory` beside the bare forest, in turns in one process: the nearest of 50,000 points, and an RRT's mix
//! (insert one, find its nearest) up to 50,000. Prints the medians of the rounds and their ratio, bare over index: 1.0
//! is no cost.

use std::time::{Duration, Instant};

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use wayfold::{Index, Space};
use wayfold_index::{Forest, ForestOptions, Points, Search};

const POINTS: usize = 50_000;
const SEARCHES: usize = 50_000;
const ROUNDS: usize = 9;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    // `cargo test --benches` only asks if it runs.
    let (points, searches, rounds) = match std::env::args().any(|argument| argument == "--bench") {
        true => (POINTS, SEARCHES, ROUNDS),
        false => (500, 500, 1),
    };
    println!("space  work    bare ns  index ns  inline ns  bare/index  bare/inline");
    for (name, space) in [("R3", "R3"), ("SE3", "R3*SO3:0.15")] {
        let space: Space = space.parse()?;
        let rows = uniform(&space, points, 1);
        let queries = uniform(&space, searches, 2);
        let (mut search, mut mix) = (Times::default(), Times::default());
        let (mut forest, index, inline) = (
            bare(&space, &rows)?,
            Index::in_memory(&space)?,
            Index::in_memory_inline(&space)?,
        );
        forest.settle();
        for row in &rows {
            index.insert(&row[..])?;
            inline.insert(&row[..])?;
        }
        for _ in 0..rounds {
            search.bare.push(time(|| {
                for row in &queries {
                    forest.search(row, &Search::nearest_k(1)).expect("a state");
                }
            }));
            search.index.push(time(|| {
                queries.iter().for_each(|row| drop(index.nearest(&row[..])))
            }));
            search.inline.push(time(|| {
                queries
                    .iter()
                    .for_each(|row| drop(inline.nearest(&row[..])))
            }));
            mix.bare.push(time(|| drop(bare_mix(&space, &rows))));
            let (index, inline) = (Index::in_memory(&space)?, Index::in_memory_inline(&space)?);
            mix.index.push(time(|| index_mix(&index, &rows)));
            mix.inline.push(time(|| index_mix(&inline, &rows)));
        }
        search.print(name, "nearest", queries.len());
        mix.print(name, "mix", rows.len());
    }
    Ok(())
}

/// The times of the rounds.
#[derive(Default)]
struct Times {
    bare: Vec<Duration>,
    index: Vec<Duration>,
    inline: Vec<Duration>,
}

impl Times {
    fn print(&mut self, space: &str, work: &str, count: usize) {
        let median = |times: &mut Vec<Duration>| {
            times.sort();
            times[times.len() / 2].as_nanos() as f64 / count as f64
        };
        let (bare, index) = (median(&mut self.bare), median(&mut self.index));
        let inline = median(&mut self.inline);
        let ratios = (bare / index, bare / inline);
        println!(
            "{space:5}  {work:7} {bare:7.0}  {index:8.0}  {inline:9.0}  {:10.3}  {:11.3}",
            ratios.0, ratios.1
        );
    }
}

fn time(work: impl FnOnce()) -> Duration {
    let start = Instant::now();
    work();
    start.elapsed()
}

fn bare(space: &Space, rows: &[Vec<f64>]) -> Result<Forest, Box<dyn std::error::Error>> {
    let mut forest = Forest::new(space.clone(), ForestOptions::for_space(space));
    let mut points = Points::with_capacity(space.coordinates(), 1);
    for (id, row) in rows.iter().enumerate() {
        insert(&mut forest, &mut points, id, row)?;
    }
    Ok(forest)
}

fn insert(
    forest: &mut Forest,
    points: &mut Points,
    id: usize,
    row: &[f64],
) -> Result<(), Box<dyn std::error::Error>> {
    points.clear();
    let revision = id as u64 + 1;
    points.push(id as u64, 0, revision, row);
    forest.apply(revision, points, &[])?;
    if id.is_multiple_of(64) {
        while let Some(merge) = forest.begin_merge() {
            forest.finish_merge(merge.run());
        }
    }
    Ok(())
}

fn bare_mix(space: &Space, rows: &[Vec<f64>]) -> Result<Forest, Box<dyn std::error::Error>> {
    let mut forest = Forest::new(space.clone(), ForestOptions::for_space(space));
    let mut points = Points::with_capacity(space.coordinates(), 1);
    for (id, row) in rows.iter().enumerate() {
        forest.search(row, &Search::nearest_k(1))?;
        insert(&mut forest, &mut points, id, row)?;
    }
    Ok(forest)
}

fn index_mix(index: &Index, rows: &[Vec<f64>]) {
    for row in rows {
        let nearest = index.nearest(&row[..]);
        nearest
            .and_then(|_| index.insert(&row[..]))
            .expect("a state");
    }
}

/// Coordinates uniform in [0, 1), rotations uniform.
fn uniform(space: &Space, rows: usize, seed: u64) -> Vec<Vec<f64>> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let row = |_| loop {
        let mut row: Vec<f64> = (0..3).map(|_| rng.random()).collect();
        let rotation: Vec<f64> = (3..space.coordinates())
            .map(|_| rng.random_range(-1.0..1.0))
            .collect();
        let norm = rotation.iter().map(|x| x * x).sum::<f64>().sqrt();
        if rotation.is_empty() || (0.1..=1.0).contains(&norm) {
            row.extend(rotation.iter().map(|x| x / norm));
            if space.canonicalize(&mut row).is_ok() {
                break row;
            }
        }
    };
    (0..rows).map(row).collect()
}
