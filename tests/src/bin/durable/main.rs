//! Measures durability: the cost of an acknowledgement, of a restart and on disk. Each figure has a bare counterpart.
//! Its last part, `writers`, shows how far inserts into an index in memory run in parallel.
//!
//!     cargo run --release -p wayfold-tests --bin durable -- [--quick] [--dir DIR] [--json FILE]

mod bare;
mod base_directory;
mod idle;
mod latency;
mod pauses;
mod rates;
mod service;
mod shape;
mod stored;
mod writers;

use std::{path::PathBuf, process::ExitCode};

use clap::{Parser, ValueEnum};
use serde_json::json;
use wayfold_tests::{measuring, report::Report};

use base_directory::{AppendFile, BaseDirectory};
use shape::Shape;

/// The server's own allocator, so that the measured program equals the shipped one; all contestants share it.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

const SPACE: &str = "R3*SO3:0.15";
const WIDTH: usize = 7;
const INDEX: &str = "durable";
const K: u32 = 10;
const CLIENTS: usize = 64;

/// Measures the cost of durability; each figure has a bare counterpart.
#[derive(Debug, Parser)]
#[command(name = "durable")]
struct Arguments {
    /// Leaves out the parts that take many minutes.
    #[arg(long)]
    quick: bool,
    /// Measures only these parts.
    #[arg(long, value_enum)]
    only: Vec<Part>,
    /// The number of rounds of a measurement; the medians are reported.
    #[arg(long, default_value_t = 5)]
    rounds: usize,
    /// A directory on the disk to measure; the system's own for temporary files if not given.
    #[arg(long)]
    dir: Option<PathBuf>,
    /// Writes the figures to a file, as JSON.
    #[arg(long)]
    json: Option<PathBuf>,
}

/// A part of the table.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Part {
    /// Acknowledged inserts a second of 64 clients.
    Rates,
    /// The latency for one client.
    Latency,
    /// The slowest calls while an index grows.
    Pauses,
    /// Restart and disk with 1,000,000 points.
    Stored,
    /// A thousand idle indices.
    Idle,
    /// Inserts a second of 64 clients into an index in memory, with neighbours.
    Writers,
}

fn main() -> ExitCode {
    measuring::main(async |arguments: Arguments| {
        let report = measure(&arguments).await;
        (report.into_json(), arguments.json)
    })
}

async fn measure(arguments: &Arguments) -> Report {
    let base = BaseDirectory::new(arguments.dir.as_deref());
    let rounds = arguments.rounds.max(1);
    let mut report = Report::default();
    let shape = Shape::read(&base).await;

    report.section("the disk", "");
    println!("  {}", base.file_system().unwrap_or_default());
    let directory = base.create();
    let mut file = AppendFile::new(directory.path());
    let mut taken: Vec<_> = (0..1000).map(|_| file.append(&[0; 4096])).collect();
    taken.sort();
    report.note(
        "append of 4 KiB and fdatasync, median",
        taken[500].as_secs_f64() * 1e3,
        "ms",
    );
    report.note(
        "one insert writes, keys and values",
        shape.bytes() as f64,
        "bytes",
    );

    report.data("rounds", json!(rounds));

    let is_asked = |part| arguments.only.is_empty() || arguments.only.contains(&part);
    if is_asked(Part::Rates) {
        let count = if arguments.quick { 40_000 } else { 100_000 };
        rates::measure(&base, &shape, (rounds, count), &mut report).await;
    }
    if is_asked(Part::Latency) {
        latency::measure(&base, &shape, rounds, &mut report).await;
    }
    if is_asked(Part::Pauses) {
        pauses::measure(&base, 1_000_000, &mut report).await;
        if !arguments.quick {
            pauses::measure(&base, 10_000_000, &mut report).await;
        }
    }
    if is_asked(Part::Stored) {
        stored::measure(&base, 1_000_000, rounds, &mut report).await;
    }
    if is_asked(Part::Idle) {
        idle::measure(&base, &mut report).await;
    }
    if is_asked(Part::Writers) {
        writers::measure(rounds, &mut report).await;
    }
    report
}
