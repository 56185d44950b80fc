//! A C-shaped body through a maze with narrow corridors: the experiment of Fig. 8 in A. Yershova, S. M. LaValle,
//! "Improving Motion Planning Algorithms by Efficient Nearest-Neighbor Searching", IEEE Transactions on Robotics, 2007.
//!
//!     cargo run --release --bin maze -- [--source memory] [--seed 1] [--runs 5]
//!     cargo run --release --bin maze -- --rrt-star 500000 --source memory
//!
//!     cargo run --release --bin maze -- --workers 4 [--source remote]
//!     cargo run --release --bin maze -- --scaling [--runs 5]
//!
//! The same trees are grown with each source of neighbours, from the same seeds; `maze.svg` shows them,
//! `maze-shared.svg` those of several workers, `maze-rrt-star.svg` the one of RRT*.

use std::process::ExitCode;

use wayfold_examples::{
    maze::{picture, scene::Maze, shared_picture, star_picture},
    planning::example::Example,
};

/// The factor by which the paper's planner became faster.
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
