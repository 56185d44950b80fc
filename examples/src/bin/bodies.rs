//! Eight rigid bodies change places between three pillars, without touching it or one another: 48 degrees of freedom,
//! the size of the experiment of Fig. 9 in A. Yershova, S. M. LaValle, "Improving Motion Planning Algorithms by
//! Efficient Nearest-Neighbor Searching", IEEE Transactions on Robotics, 2007.
//!
//!     cargo run --release --bin bodies -- [--source memory] [--seed 1] [--runs 5]
//!
//!     cargo run --release --bin bodies -- --workers 4 [--source remote]
//!
//! The same trees are grown with each source of neighbours, from the same seeds; `bodies.svg` shows them.

use std::process::ExitCode;

use wayfold_examples::{
    bodies::{picture, scene::Room},
    planning::example::Example,
};

fn main() -> ExitCode {
    let example = Example {
        name: "bodies",
        paper: None,
        draw: picture::draw,
        draw_shared: None,
        draw_star: None,
    };
    example.run(Room::new)
}
