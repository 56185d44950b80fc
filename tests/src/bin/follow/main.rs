//! Measures a replica that follows a server, and the same forest in this process, fed at the same rate, for comparison.
//!
//!     cargo run --release -p wayfold-tests --bin follow -- [--points 50000] [--rate 10000] [--rounds 5] [--over-zenoh]
//!         [--json FILE]
//!
//! A server in a process of its own holds SE(3) points (`R3*SO3:0.15`); a writer here inserts more of them at a fixed
//! rate. One thread asks for ten neighbours on end, in turns a replica and a forest that is fed without the network;
//! its rate is counted by its own processor time, so that what else runs here does not count. How long after its
//! acknowledgement an insert is in the replica is compared with calls to a bare echo, made at the same time.

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
    /// How many points there are before.
    #[arg(long, default_value_t = 50_000)]
    points: usize,
    /// How many points are inserted a second.
    #[arg(long, default_value_t = 10_000)]
    rate: usize,
    /// How many points are inserted in one call.
    #[arg(long, default_value_t = 10)]
    batch: usize,
    /// How many seconds each measurement lasts.
    #[arg(long, default_value_t = 3)]
    seconds: usize,
    /// How often each is measured; the medians are reported.
    #[arg(long, default_value_t = 5)]
    rounds: usize,
    /// The replica hears of mutations over Zenoh, not over gRPC.
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
