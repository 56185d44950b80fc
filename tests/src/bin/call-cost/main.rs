//! Measures what admission, authentication and metrics add to a call.
//!
//!     cargo run --release -p wayfold-tests --bin call-cost -- [--rounds 10] [--json FILE]
//!
//! One program makes the same calls with identities and metrics and without them, in turns of a few milliseconds, so
//! that what else the machine does meets both. The figure is the median of the differences of neighbouring turns. The
//! same difference between two contestants that are equal shows how far it can be trusted.
//!
//! `in_process` makes `Knn` calls through the server's layer around them and its service, without a connection:
//! nothing but the code of a call. Admission cannot be left out of a call, so one contestant admits each call twice.
//! `end_to_end` makes them to servers in other processes, and takes the processor time of each server.

mod end_to_end;
mod in_process;

use std::{fmt, fs, path::PathBuf, process::ExitCode};

use clap::Parser;
use serde_json::{Value, json};
use wayfold_tests::{figures::median, measuring};

/// The server's own allocator, so that the measured program equals the shipped one.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

const SPACE: &str = "R3*SO3:0.15";
const WIDTH: usize = 7;
const INDEX: &str = "cell-3-arm";
const POINTS: usize = 1_000;
const K: u32 = 10;

/// A token as `wayfold token create` makes them, and its SHA-256.
const TOKEN: &str = "wayfold_0123456789abcdef0123456789abcdef0123456789abcdef0123456789abcdef";
const TOKEN_SHA256: &str = "a5bf5317aeb9fd0a7798af001e66e25aa8a8a5716da96c48c3426e1fdad2c757";

/// Measures what admission, authentication and metrics add to a call.
#[derive(Debug, Parser)]
#[command(name = "call-cost")]
struct Arguments {
    /// The number of rounds, each with processes and states of its own.
    #[arg(long, default_value_t = 10)]
    rounds: usize,
    /// Writes the figures to a file, as JSON.
    #[arg(long)]
    json: Option<PathBuf>,
}

fn main() -> ExitCode {
    measuring::main(async |arguments: Arguments| {
        let directory = tempfile::tempdir().expect("a directory");
        let identities = directory.path().join("identities.toml");
        fs::write(&identities, self::identities()).expect("a file");
        let rounds = arguments.rounds.max(1);
        let in_process = in_process::measure(&identities, rounds).await;
        let end_to_end = end_to_end::measure(&identities, rounds).await;
        let mut figures = json!({ "rounds": rounds });
        for (place, added) in [("in_process", in_process), ("end_to_end", end_to_end)] {
            for (what, added) in added {
                println!("{place}, {what}: {added}");
                figures[place][what] = added.to_json();
            }
        }
        (figures, arguments.json)
    })
}

/// The identities of several teams. The last one calls, so the server compares all digests.
fn identities() -> String {
    const OTHERS: usize = 19;
    let identity = |name: &str, digest: &str| {
        format!(
            "[[identity]]\nname = \"{name}\"\nrole = \"admin\"\nindexes = [\"load-*\", \"{name}-*\"]\n\
             expires = \"2099-12-31T00:00:00Z\"\nmax_calls = 1000\ntoken_sha256 = \"{digest}\"\n"
        )
    };
    let others = (0..OTHERS).map(|n| identity(&format!("team-{n}"), &format!("{n:064x}")));
    others.collect::<String>() + &identity("cell-3", TOKEN_SHA256)
}

/// The added time of a contestant's calls over those of the contestant without anything, turn by turn, in microseconds a
/// call.
#[derive(Default)]
struct Added {
    differences_us: Vec<f64>,
    /// The time of a call without identities and metrics.
    bare_us: Vec<f64>,
}

impl Added {
    fn push(&mut self, us: f64, bare_us: f64) {
        self.differences_us.push(us - bare_us);
        self.bare_us.push(bare_us);
    }

    /// The quarters of the differences: half of them lie between the first and the last.
    fn quartiles(&self) -> [f64; 3] {
        let mut sorted = self.differences_us.clone();
        sorted.sort_by(f64::total_cmp);
        [1, 2, 3].map(|quarter| sorted[quarter * (sorted.len() - 1) / 4])
    }

    fn to_json(&self) -> Value {
        let [low, middle, high] = self.quartiles();
        json!({
            "added_us": middle,
            "quartiles_us": [low, high],
            "bare_us": median(self.bare_us.clone()),
            "turns": self.differences_us.len(),
        })
    }
}

impl fmt::Display for Added {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let ([low, middle, high], bare) = (self.quartiles(), median(self.bare_us.clone()));
        write!(
            f,
            "{middle:.2} us a call ({low:.2} to {high:.2}) over {bare:.1}"
        )
    }
}
