//! A C-shaped body through a maze with narrow corridors: the experiment of Fig. 8 in A. Yershova, S. M. LaValle,
//! "Improving Motion Planning Algorithms by Efficient Nearest-Neighbor Searching", IEEE Transactions on Robotics, 2007.
//!
//!     cargo run --release -p wayfold --example maze -- [--source forest] [--seed 1] [--runs 5]
//!     cargo run --release -p wayfold --example maze -- --rrt-star 500000 --source forest
//!
//!     cargo run --release -p wayfold --example maze -- --workers 4 [--source replica]
//!     cargo run --release -p wayfold --example maze -- --scaling [--runs 5]
//!
//! The same trees are grown with each source of neighbours, from the same seeds; `maze.svg` shows them, `maze-shared.svg` those
//! of several workers, `maze-rrt-star.svg` the one of RRT*.

#[path = "../planning/mod.rs"]
mod planning;

mod picture;
mod scene;
mod shared_picture;
mod star_picture;

use std::process::ExitCode;

use planning::example::Example;
use scene::Maze;

/// By what the paper's planner became faster.
const PAPER: f64 = 75.0;

fn main() -> ExitCode {
    let example = Example {
        name: "maze",
        paper: Some(PAPER),
        draw: picture::draw,
        draw_shared: Some(shared_picture::draw),
        draw_star: Some(star_picture::draw),
    };
    example.run(Maze::new)
}
