//! Measures a server under more load than it can bear, and beside clients that hold what they can.
//!
//!     cargo run --release -p wayfold-tests --bin overload -- [SCENARIO...] [--seconds 8] [--server PATH]
//!         [--server-core 0] [--client-core 1] [--points 50000] [--set grpc.max_calls=64] [--json FILE]
//!
//! It starts the server in memory, its own or the program of another version, and fills an index of SE(3) (`R3*SO3:0.15`).
//! The server has one core, all callers share another. Every answer of the server is counted, errors too.
//!
//! Calls on a schedule count from the time at which they were due, and so do those of the callers beside a load. A call
//! without an answer counts there with the time that it waited.

mod burst;
mod generator;
mod goodput;
mod half_sent;
mod heavy;
mod left;
mod pin;
mod probe;
mod report;
mod server;
mod silent;
mod soak;
mod tally;
mod unread;
mod wire;

use std::{
    path::PathBuf,
    process::ExitCode,
    time::{Duration, Instant},
};

use clap::{Parser, ValueEnum};
use serde_json::json;
use wayfold_tests::measuring;

use report::Report;

/// The server's own allocator: the system's is slower, and the generator must be faster than the server.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

/// Measures a server under more load than it can bear, and beside clients that hold what they can.
#[derive(Debug, Parser)]
#[command(name = "overload")]
struct Arguments {
    /// The scenarios; all if none is given.
    #[arg(value_enum)]
    scenarios: Vec<Scenario>,
    /// The program of another server; without it, this program is the server too.
    #[arg(long, value_parser = server::program)]
    server: Option<PathBuf>,
    /// The core of the server.
    #[arg(long, default_value_t = 0)]
    server_core: usize,
    /// The core of all callers.
    #[arg(long, default_value_t = 1)]
    client_core: usize,
    /// The number of points in the index.
    #[arg(long, default_value_t = 50_000)]
    points: usize,
    /// The duration of each phase in seconds.
    #[arg(long, default_value_t = 8)]
    seconds: u32,
    /// A setting of the server, as in grpc.max_calls=64.
    #[arg(long, value_name = "KEY=VALUE", value_parser = server::setting)]
    set: Vec<(String, String)>,
    /// Writes the figures to a file, as JSON.
    #[arg(long)]
    json: Option<PathBuf>,
}

impl Arguments {
    /// The duration of a phase.
    fn length(&self) -> Duration {
        Duration::from_secs(u64::from(self.seconds.max(1)))
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Scenario {
    /// Two and four times as many calls as the server can answer.
    Goodput,
    /// Workers that all ask at once every second.
    Burst,
    /// Inserts that never end.
    HalfSent,
    /// Large answers that no caller reads.
    Unread,
    /// One connection with 250 large searches.
    Heavy,
    /// Connections that say nothing, and calls of headers alone.
    Silent,
    /// Queries over Zenoh whose client has left.
    Left,
    /// Twice the load that the server can answer, by processes that are killed in turn; `--seconds 600` for ten
    /// minutes.
    Soak,
}

impl Scenario {
    fn run(self, arguments: &Arguments, report: &mut Report) {
        match self {
            Self::Goodput => goodput::run(arguments, report),
            Self::Burst => burst::run(arguments, report),
            Self::HalfSent => half_sent::run(arguments, report),
            Self::Unread => unread::run(arguments, report),
            Self::Heavy => heavy::run(arguments, report),
            Self::Silent => silent::run(arguments, report),
            Self::Left => left::run(arguments, report),
            Self::Soak => soak::run(arguments, report),
        }
    }
}

fn main() -> ExitCode {
    match measuring::role().as_deref() {
        Some(server::PINNED) => return server::become_server(),
        Some(left::LEAVER) => return left::leave(),
        Some(soak::LOADER) => return soak::load(),
        _ => {}
    }
    measuring::main(async |arguments: Arguments| {
        let report = tokio::task::block_in_place(|| measure(&arguments));
        (report.into_json(), arguments.json)
    })
}

fn measure(arguments: &Arguments) -> Report {
    // The threads and processes that are started from here on inherit both; the server has a limit of its own.
    pin::to_core(arguments.client_core);
    pin::raise_file_limit();
    let mut report = Report::default();
    report.note("seconds", arguments.seconds.into());
    report.note("points", arguments.points.into());
    report.note("settings", json!(arguments.set));
    let scenarios = match arguments.scenarios.as_slice() {
        [] => Scenario::value_variants(),
        some => some,
    };
    for scenario in scenarios {
        let began = Instant::now();
        scenario.run(arguments, &mut report);
        progress(&format!(
            "{scenario:?}: done in {:.0} s",
            began.elapsed().as_secs_f64()
        ));
    }
    report
}

/// Says to standard error what is measured now.
fn progress(text: &str) {
    eprintln!("{text}");
}
