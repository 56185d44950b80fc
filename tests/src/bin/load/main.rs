//! Measures a server under load, and a bare tonic echo of the same messages for comparison.
//!
//!     cargo run --release -p wayfold-tests --bin load -- [--points 1000000] [--rounds 5] [--json FILE]
//!
//! It starts the server in a separate process, inserts SE(3) points (`R3*SO3:0.15`) in batches while a reader queries,
//! and then searches ten neighbours in four ways: one call in flight, 64 in flight, batches of 1,000 states, and one
//! pipelined stream. The echo takes the same requests and answers messages of the same size without looking at them:
//! its rate is the limit that the protocol sets. This process also does the same search: no server can take less time
//! than the echo and that search together. Finally 64 writers insert without the network, and request neighbours.

mod growth;
mod in_process;
mod report;
mod searcher;
mod writers;

use std::{path::PathBuf, process::ExitCode};

use clap::Parser;
use indicatif::{ProgressBar, ProgressStyle};
use wayfold_tests::{Stubs, figures::resident_bytes, measuring};

use in_process::InProcess;
use report::{Report, Round};
use searcher::{CallPattern, Searcher};

/// The server's own allocator, so that the measured program equals the shipped one; all contestants share it.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

const SPACE: &str = "R3*SO3:0.15";
const INDEX: &str = "load";
const WIDTH: usize = 7;
const K: u32 = 10;

/// Measures a server under load, and a bare tonic echo of the same messages for comparison.
#[derive(Debug, Parser)]
#[command(name = "load")]
struct Arguments {
    /// The number of points to insert, in batches of 1,000.
    #[arg(long, default_value_t = 1_000_000)]
    points: usize,
    /// The number of rounds; the medians are reported.
    #[arg(long, default_value_t = 5)]
    rounds: usize,
    /// Writes the figures to a file, as JSON.
    #[arg(long)]
    json: Option<PathBuf>,
}

fn main() -> ExitCode {
    measuring::main(async |arguments: Arguments| {
        let report = measure(&arguments).await;
        print!("{report}");
        (report.to_json(), arguments.json)
    })
}

async fn measure(arguments: &Arguments) -> Report {
    let (server, echo) = (measuring::server("memory"), measuring::echo());
    let mut server_stubs = Stubs::connect(server.uri()).await;
    let echo_stubs = Stubs::connect(echo.uri()).await;
    server_stubs.create(INDEX, SPACE).await;

    let rounds = arguments.rounds.max(1);
    let steps = arguments.points
        + rounds * (CallPattern::ALL.len() + writers::BATCHES.len()) * searcher::STEPS;
    // Drawn to standard error, and only if that is a terminal.
    let style = ProgressStyle::with_template("{msg:24} {wide_bar} {percent:>3} %  {eta}");
    let progress = ProgressBar::new(steps as u64).with_style(style.expect("a template"));

    let resident_before = resident_bytes(server.process().id());
    let echo_growth = growth::grow(&echo_stubs, arguments.points, &ProgressBar::hidden()).await;
    progress.set_message("inserting");
    let server_growth = growth::grow(&server_stubs, arguments.points, &progress).await;
    let resident_after = resident_bytes(server.process().id());
    let described = server_stubs.describe(INDEX).await;

    let mut report = Report {
        rounds,
        growth: (server_growth, echo_growth),
        asking: Vec::new(),
        written: Vec::new(),
        points: described.point_count,
        memory_bytes: described.memory_bytes,
        resident_bytes: resident_before.zip(resident_after),
    };
    let inside = InProcess::new(arguments.points);
    for way in CallPattern::ALL {
        progress.set_message(way.to_string());
        let mut measured = Vec::new();
        // The contestants take turns, so that other load on the machine affects all of them.
        for round in 0..rounds as u64 {
            let mut asker = Searcher::new(way, round);
            measured.push(Round {
                server: asker.measure(&server_stubs, &server).await,
                echo: asker.measure(&echo_stubs, &echo).await,
                search_us: inside.search_us(round),
            });
            progress.inc(searcher::STEPS as u64);
        }
        report.add(way, &measured);
    }
    for batch in writers::BATCHES {
        progress.set_message(format!("64 writers, batches of {batch}"));
        let mut measured = Vec::new();
        for round in 0..rounds as u64 {
            measured.push(writers::write(batch, round).await);
            progress.inc(searcher::STEPS as u64);
        }
        report.add_written(batch, &measured);
    }
    progress.finish_and_clear();
    report
}
