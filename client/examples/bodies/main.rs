//! Eight rigid bodies change places through a window, without touching it or one another: 48 degrees of freedom, the
//! size of the experiment of Fig. 9 in A. Yershova, S. M. LaValle, "Improving Motion Planning Algorithms by Efficient
//! Nearest-Neighbor Searching", IEEE Transactions on Robotics, 2007.
//!
//!     cargo run --release -p wayfold-client --example bodies -- [--source forest] [--seed 1] [--runs 5]
//!
//! The same trees are grown with each source of neighbours, from the same seeds; `bodies.svg` shows them.

#[path = "../planning/mod.rs"]
mod planning;

mod picture;
mod projection;
mod scene;

use std::{path::Path, process::ExitCode};

use clap::Parser;
use planning::{comparison, error::PlanningError, options::Options, path, report, server};
use scene::Room;

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
    let room = Room::new();
    let comparison = comparison::compare(&room, options)?;
    print!("{}", report::table(&comparison, None));
    let path = &comparison.solution.path;
    let checked = path::verify(&room, path)?;
    println!(
        "The path of seed {} is free in {checked} states, by other code.",
        options.seed
    );
    if let Some(file) = &options.json {
        report::write_json(&comparison, file)?;
    }
    let shorter = path::shorten(&room, path.clone(), 2000, options.seed);
    picture::draw(&room, &comparison, &shorter, Path::new("bodies.svg"))
}
