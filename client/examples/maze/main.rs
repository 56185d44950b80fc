//! A C-shaped body through a maze with narrow corridors: the experiment of Fig. 8 in A. Yershova, S. M. LaValle,
//! "Improving Motion Planning Algorithms by Efficient Nearest-Neighbor Searching", IEEE Transactions on Robotics, 2007.
//!
//!     cargo run --release -p wayfold-client --example maze -- [--source forest] [--seed 1] [--runs 5]
//!     cargo run --release -p wayfold-client --example maze -- --rrt-star 500000 --source forest
//!
//! The same trees are grown with each source of neighbours, from the same seeds; `maze.svg` shows them.

#[path = "../planning/mod.rs"]
mod planning;

mod picture;
mod scene;

use std::process::ExitCode;

use planning::example;
use scene::Maze;

/// By what the paper's planner became faster.
const PAPER: f64 = 75.0;

fn main() -> ExitCode {
    example::run(Maze::new, Some(PAPER), "maze.svg", picture::draw)
}
