//! Measures a replica that follows a server, and the same forest in this process, fed at the same rate, for comparison.
//!
//!     cargo run --release -p wayfold-tests --bin follow -- [--points 50000] [--rate 10000] [--rounds 5] [--over-zenoh]
//!         [--json FILE]
//!
//! A server in a separate process holds SE(3) points (`R3*SO3:0.15`), and a writer in this process inserts more of them
//! at a fixed rate. One thread continuously searches ten neighbours, in turns in a replica and in a forest that is fed
//! without the network. Its rate refers to its own processor time, so that other load does not count. The delay from an
//! insert's acknowledgement to its arrival in the replica is compared with simultaneous calls to a bare echo.

mod feed;
mod phase;
mod report;

use std::{path::PathBuf, process::ExitCode};

use clap::Parser;
use indicatif::{ProgressBar, ProgressStyle};
use wayfold::Client;
use wayfold_tests::{Stubs, measuring};

use phase::Setting;
use report::Report;

const SPACE: &str = "R3*SO3:0.15";
const WIDTH: usize = 7;
const K: u32 = 10;

/// The server's own allocator, so that the measured program equals the shipped one; all contestants share it.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

/// Measures a replica that follows a server, and the same forest in this process for comparison.
#[derive(Debug, Parser)]
#[command(name = "follow")]
struct Arguments {
    /// The number of points at the start.
    #[arg(long, default_value_t = 50_000)]
    points: usize,
    /// The number of points inserted per second.
    #[arg(long, default_value_t = 10_000)]
    rate: usize,
    /// The number of points inserted in one call.
    #[arg(long, default_value_t = 10)]
    batch: usize,
    /// The duration of each measurement in seconds.
    #[arg(long, default_value_t = 3)]
    seconds: usize,
    /// The number of rounds; the medians are reported.
    #[arg(long, default_value_t = 5)]
    rounds: usize,
    /// The replica receives mutations over Zenoh, not over gRPC.
    #[arg(long)]
    over_zenoh: bool,
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
    let (mut server, echo) = (measuring::server_over_zenoh("memory"), measuring::echo());
    let session = match arguments.over_zenoh {
        true => Some(measuring::connect(&server.zenoh()).await),
        false => None,
    };
    let client = Client::connect(server.uri()).await.expect("a server");
    let stubs = Stubs::connect(echo.uri()).await;
    let rounds = arguments.rounds.max(1);
    let style = ProgressStyle::with_template("{wide_bar} {percent:>3} %  {eta}");
    let progress = ProgressBar::new(2 * rounds as u64).with_style(style.expect("a template"));
    let setting = Setting {
        points: arguments.points,
        batch: arguments.batch.max(1),
        calls_per_second: (arguments.rate / arguments.batch.max(1)).max(1),
        seconds: arguments.seconds.max(1),
        session,
    };
    let mut report = Report::new(&setting);
    for round in 0..rounds as u64 {
        report.add_replica(phase::replica(&client, &stubs, &setting, round).await);
        progress.inc(1);
        report.add_forest(phase::forest(&client, &stubs, &setting, round).await);
        progress.inc(1);
    }
    progress.finish_and_clear();
    report
}
