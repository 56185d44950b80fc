//! The searches of a file of rows in Rust; `race-shipped rows` makes them in C++. `client/cpp/race` runs both.
//!
//!     rows FILE POINTS K

use std::{env, error::Error, fs};

use client::{Index, Search};
use rustix::time::{ClockId, clock_gettime};

fn own_seconds() -> f64 {
    let time = clock_gettime(ClockId::ThreadCPUTime);
    time.tv_sec as f64 + 1e-9 * time.tv_nsec as f64
}

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = env::args().skip(1).collect();
    let [file, points, k] = &arguments[..] else {
        return Err("rows FILE POINTS K".into());
    };
    let (points, k): (usize, u32) = (points.parse()?, k.parse()?);
    let bytes = fs::read(file)?;
    let (numbers, _) = bytes.as_chunks();
    let numbers: Vec<f64> = numbers
        .iter()
        .map(|bytes| f64::from_ne_bytes(*bytes))
        .collect();
    let index = Index::in_memory_inline(&"R3*SO3:0.15".parse()?)?;
    let width = 7;
    let (stored, queries) = numbers.split_at(points * width);
    for row in stored.chunks_exact(width) {
        index.insert(row)?;
    }
    let search = Search::k(k);
    let (mut found, mut sum) = (Vec::new(), 0_u64);
    let began = own_seconds();
    for row in queries.chunks_exact(width) {
        if k == 1 {
            let nearest = index.nearest(row)?.ok_or("no points")?;
            sum = sum.wrapping_mul(31).wrapping_add(nearest.id);
            continue;
        }
        index.search_into(row, &search, &mut found)?;
        for neighbor in &found {
            sum = sum.wrapping_mul(31).wrapping_add(neighbor.id);
        }
    }
    let seconds = (own_seconds() - began) * width as f64 / queries.len() as f64;
    println!("{{\"seconds\": {seconds}, \"sum\": \"{sum}\"}}");
    Ok(())
}
