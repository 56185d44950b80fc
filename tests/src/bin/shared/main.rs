//! Measures the shared index: how long a planner waits for an insert, and how long others wait for the point.
//!
//!     cargo run --release -p wayfold-tests --bin shared -- [--rate 50000] [--seconds 10] [--only insert|visible]
//!         [--dir DIR] [--json FILE]
//!
//! The server has its default durability and runs in a separate process. One thread inserts at a fixed rate, which it
//! keeps by spinning: the latency of an insert counts from the time at which it was due. A thread that inserts nothing
//! shows what the machine adds. Then writers in separate processes insert at the same rate in all, and the time until
//! this process's copy has each point is compared with appends of 4 KiB to a file and fdatasync.

mod insert;
mod report;
mod visible;

use std::{path::PathBuf, process::ExitCode};

use clap::{Parser, ValueEnum};
use tempfile::TempDir;
use wayfold_tests::measuring;

use report::Report;

const R3: &str = "R3";
const SE3: &str = "R3*SO3:0.15";

/// The server's own allocator, so that the measured program equals the shipped one.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

/// Measures how long a planner waits for an insert into a shared index, and how long others wait for the point.
#[derive(Debug, Parser)]
#[command(name = "shared")]
struct Arguments {
    /// The number of points inserted per second, over all writers.
    #[arg(long, default_value_t = 50_000)]
    rate: u32,
    /// The duration of each measurement in seconds.
    #[arg(long, default_value_t = 10)]
    seconds: u32,
    /// Measures only this part.
    #[arg(long, value_enum)]
    only: Option<Part>,
    /// A directory on the disk to measure; the system's own for temporary files if not given.
    #[arg(long)]
    dir: Option<PathBuf>,
    /// Writes the figures to a file, as JSON.
    #[arg(long)]
    json: Option<PathBuf>,
}

/// A part of the figures.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Part {
    /// The latency of an insert.
    Insert,
    /// The time until another process has the point.
    Visible,
}

impl Arguments {
    /// A new directory on the measured disk.
    fn directory(&self) -> TempDir {
        let parent = self.dir.clone().unwrap_or_else(std::env::temp_dir);
        tempfile::tempdir_in(parent).expect("a directory to write in")
    }
}

fn main() -> ExitCode {
    if measuring::role().as_deref() == Some(visible::WRITER) {
        wayfold_server::use_small_pages();
        return visible::write();
    }
    measuring::main(async |arguments: Arguments| {
        let report = tokio::task::block_in_place(|| measure(&arguments));
        (report.into_json(), arguments.json)
    })
}

fn measure(arguments: &Arguments) -> Report {
    let mut report = Report::new(arguments.rate, arguments.seconds);
    if arguments.only != Some(Part::Visible) {
        for space in [R3, SE3] {
            insert::measure(arguments, space, &mut report);
        }
    }
    if arguments.only != Some(Part::Insert) {
        for writers in [1, 4] {
            visible::measure(arguments, writers, &mut report);
        }
    }
    report
}
