//! `Index::in_memory` beside the bare forest, in turns in one process: the nearest of 50,000 points, and an RRT's mix
//! (find the nearest of a state, insert it) up to 50,000. Prints the medians of the rounds, of their times and of their
//! ratio, bare over index: 1.0 is no cost.
//!
//!     cargo bench -p wayfold --bench index [-- --json FILE]

use std::{
    env, fs,
    time::{Duration, Instant},
};

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use wayfold::{Index, Space};
use wayfold_index::{Forest, ForestOptions, Points, Search};

const POINTS: usize = 50_000;
const SEARCHES: usize = 50_000;
const ROUNDS: usize = 15;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<String> = env::args().collect();
    // `cargo test --benches` only asks if it runs.
    let (points, searches, rounds) = match arguments.iter().any(|argument| argument == "--bench") {
        true => (POINTS, SEARCHES, ROUNDS),
        false => (500, 500, 1),
    };
    let json = arguments.iter().position(|argument| argument == "--json");
    let json = json.map(|at| arguments.get(at + 1).expect("a file after --json"));
    let mut rows = Vec::new();
    println!("space  work    bare ns  index ns  inline ns  bare/index  bare/inline");
    for (name, space) in [("R3", "R3"), ("SE3", "R3*SO3:0.15")] {
        let space: Space = space.parse()?;
        let states = uniform(&space, points, 1);
        let queries = uniform(&space, searches, 2);
        let (mut search, mut mix) = (Times::default(), Times::default());
        let (mut forest, index, inline) = (
            bare(&space, &states)?,
            Index::in_memory(&space)?,
            Index::in_memory_inline(&space)?,
        );
        forest.settle();
        for row in &states {
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
            let (mut forest, index, inline) = (
                empty(&space),
                Index::in_memory(&space)?,
                Index::in_memory_inline(&space)?,
            );
            mix.bare.push(time(|| bare_mix(&mut forest, &states)));
            mix.index.push(time(|| index_mix(&index, &states)));
            mix.inline.push(time(|| index_mix(&inline, &states)));
        }
        rows.push(search.print(name, "nearest", queries.len()));
        rows.push(mix.print(name, "mix", states.len()));
    }
    if let Some(file) = json {
        fs::write(file, format!("[{}]\n", rows.join(",\n")))?;
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
    /// Prints a row of the table, and returns it as JSON.
    fn print(&self, space: &str, work: &str, count: usize) -> String {
        let time = |times: &[Duration]| {
            median(times.iter().map(Duration::as_nanos).map(|ns| ns as f64)) / count as f64
        };
        let ratio = |times: &[Duration]| {
            let rounds = self.bare.iter().zip(times);
            median(rounds.map(|(bare, index)| bare.as_secs_f64() / index.as_secs_f64()))
        };
        let [bare, index, inline] = [&self.bare, &self.index, &self.inline].map(|it| time(it));
        let (to_index, to_inline) = (ratio(&self.index), ratio(&self.inline));
        println!(
            "{space:5}  {work:7} {bare:7.0}  {index:8.0}  {inline:9.0}  {to_index:10.3}  {to_inline:11.3}"
        );
        format!(
            "{{\"space\": \"{space}\", \"work\": \"{work}\", \"bare_ns\": {bare}, \"index_ns\": {index}, \"inline_ns\": {inline}, \"ratio\": {to_index}, \"inline_ratio\": {to_inline}}}"
        )
    }
}

fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

fn time(work: impl FnOnce()) -> Duration {
    let start = Instant::now();
    work();
    start.elapsed()
}

fn empty(space: &Space) -> Forest {
    Forest::new(space.clone(), ForestOptions::for_space(space))
}

fn bare(space: &Space, rows: &[Vec<f64>]) -> Result<Forest, Box<dyn std::error::Error>> {
    let mut forest = empty(space);
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
        forest.settle();
    }
    Ok(())
}

fn bare_mix(forest: &mut Forest, rows: &[Vec<f64>]) {
    let mut points = Points::with_capacity(forest.space().coordinates(), 1);
    for (id, row) in rows.iter().enumerate() {
        let nearest = forest.search(row, &Search::nearest_k(1));
        drop(nearest.expect("a state"));
        insert(forest, &mut points, id, row).expect("a state");
    }
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
