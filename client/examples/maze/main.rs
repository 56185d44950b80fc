//! A C-shaped body through a maze with narrow corridors: the experiment of Fig. 8 in A. Yershova, S. M. LaValle,
//! "Improving Motion Planning Algorithms by Efficient Nearest-Neighbor Searching", IEEE Transactions on Robotics, 2007.
//!
//!     cargo run --release -p wayfold-client --example maze -- [--source forest] [--seed 1] [--runs 5]
//!
//! The same trees are grown with each source of neighbours, from the same seeds; `maze.svg` shows them.

#[path = "../planning/mod.rs"]
mod planning;

mod picture;
mod scene;

use std::{path::Path, process::ExitCode};

use clap::Parser;
use planning::{comparison, error::PlanningError, options::Options, path, report, server};
use scene::Maze;

/// By what the paper's planner became faster.
const PAPER: f64 = 75.0;

fn main() -> ExitCode {
    if let Some(ended) = server::serve_if_told() {
        return ended;
    }
    match run(&Options::parse()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error}");
            ExitCode::FAILURE
        }
    }
}

fn run(options: &Options) -> Result<(), PlanningError> {
    let maze = Maze::new();
    let comparison = comparison::compare(&maze, options)?;
    print!("{}", report::table(&comparison, Some(PAPER)));
    let path = &comparison.solution.path;
    let checked = path::verify(&maze, path)?;
    println!(
        "The path of seed {} is free in {checked} states, by other code.",
        options.seed
    );
    if let Some(file) = &options.json {
        report::write_json(&comparison, file)?;
    }
    let shorter = path::shorten(&maze, path.clone(), 2000, options.seed);
    picture::draw(&maze, &comparison, &shorter, Path::new("maze.svg"))
}
