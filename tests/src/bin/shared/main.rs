//! Measures the shared index: how long a planner waits for an insert, and how long others wait for the point.
//!
//!     cargo run --release -p wayfold-tests --bin shared -- [--rate 50000] [--seconds 10] [--only insert|visible]
//!         [--dir DIR] [--json FILE]
//!
//! The server has its default durability and runs in a separate process. One thread inserts at a fixed rate, which it
//! keeps by spinning: the latency of an insert counts from the time at which it was due. A thread that inserts nothing
//! shows what the machine adds. Then writers in separate processes insert at the same rate in all, and the time until
//! this process's copy has each point is compared with appends of 4 KiB to a file and fdatasync.

#[path = "../durable/base_directory.rs"]
#[expect(dead_code, reason = "`durable` also measures the space on the disk")]
mod base_directory;
mod insert;
mod visible;

use std::{fs, path::PathBuf, process::ExitCode};

use clap::{Parser, ValueEnum};
use wayfold_tests::{measuring, report::Report};

use base_directory::BaseDirectory;

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
    let (rate, seconds, processor) = (arguments.rate, arguments.seconds, processor());
    println!("{rate} inserts a second for {seconds} s; {processor}");
    let mut report = Report::default();
    report.data("rate", rate.into());
    report.data("seconds", seconds.into());
    report.data("processor", processor.into());
    let base = BaseDirectory::new(arguments.dir.as_deref());
    if arguments.only != Some(Part::Visible) {
        for space in [R3, SE3] {
            insert::measure(arguments, base.create().path(), space, &mut report);
        }
    }
    if arguments.only != Some(Part::Insert) {
        for writers in [1, 4] {
            visible::measure(arguments, base.create().path(), writers, &mut report);
        }
    }
    report
}

/// The processor and the number of its cores, as far as the system names them.
fn processor() -> String {
    let text = fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let lines = text.lines().filter_map(|line| line.split_once(':'));
    let model = lines
        .filter(|(name, _)| name.trim() == "model name")
        .map(|(_, model)| model.trim())
        .next();
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    format!("{}, {cores} cores", model.unwrap_or("a processor"))
}
