//! Measures the server over Zenoh, and a bare queryable that answers the same bytes.
//!
//!     cargo run --release -p wayfold-tests --bin robots -- [--points 50000] [--rounds 5] [--json FILE]
//!
//! It starts the server in a separate process, inserts SE(3) points (`R3*SO3:0.15`), and searches ten neighbours of one
//! state, with one query in flight and with 64. The bare queryable returns a typical answer of the server without
//! reading the query: its rate is the limit that Zenoh sets. All share one machine.

mod bare;
mod searcher;

use std::{path::PathBuf, process::ExitCode};

use clap::Parser;
use serde_json::json;
use wayfold_index::Space;
use wayfold_tests::{
    States, Stubs,
    figures::{median, quantile_ms},
    insert_request, measuring,
    report::Report,
};

use searcher::{Form, Searcher};

/// The server's own allocator, so that the measured program equals the shipped one; all contestants share it.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

/// The role of the bare queryable's process.
const BARE: &str = "bare";
const SPACE: &str = "R3*SO3:0.15";
const INDEX: &str = "arm";
const WIDTH: usize = 7;
const K: u32 = 10;
const BATCH: usize = 1_000;
/// The figures of a form, and their units.
const FIGURES: [(&str, &str); 4] = [
    ("one in flight, p50", "us"),
    ("one in flight, p99", "us"),
    ("64 in flight, answers", "/s"),
    ("processor an answer", "us"),
];

/// Measures the server over Zenoh, and a bare queryable for comparison.
#[derive(Debug, Parser)]
#[command(name = "robots")]
struct Arguments {
    /// The number of points to insert.
    #[arg(long, default_value_t = 50_000)]
    points: usize,
    /// The number of rounds; the medians are reported.
    #[arg(long, default_value_t = 5)]
    rounds: usize,
    /// Writes the figures to a file, as JSON.
    #[arg(long)]
    json: Option<PathBuf>,
}

fn main() -> ExitCode {
    if measuring::role().as_deref() == Some(BARE) {
        return bare::main();
    }
    measuring::main(async |arguments: Arguments| {
        let report = measure(&arguments).await;
        (report.into_json(), arguments.json)
    })
}

async fn measure(arguments: &Arguments) -> Report {
    let space: Space = SPACE.parse().expect("a space");
    let rows = States::new(space.clone(), 1).rows(arguments.points);
    let mut server = measuring::server_over_zenoh("memory");
    let mut bare = measuring::start(BARE, &[]);
    let mut stubs = Stubs::connect(server.uri()).await;
    stubs.create(INDEX, SPACE).await;
    for rows in rows.chunks(BATCH * WIDTH) {
        stubs.insert(insert_request(INDEX, rows, WIDTH)).await;
    }
    let rounds = arguments.rounds.max(1);
    let contestants = [
        (measuring::connect(&server.zenoh()).await, server.process()),
        (measuring::connect(&bare.zenoh()).await, bare.process()),
    ];
    println!("{SPACE}, {} points, k = {K}", arguments.points);
    let mut report = Report::default();
    report.data("points", json!(arguments.points));
    report.data("rounds", json!(rounds));
    for form in [Form::Protobuf, Form::Json] {
        let mut measured: [[Vec<f64>; 2]; FIGURES.len()] = Default::default();
        for round in 0..rounds {
            let searcher = Searcher::new(&space, form, round as u64);
            // The contestants take turns, so that other load on the machine affects both.
            for (of, (session, _)) in contestants.iter().enumerate() {
                let taken = searcher.one(session).await;
                measured[0][of].push(quantile_ms(&taken, 0.5) * 1e3);
                measured[1][of].push(quantile_ms(&taken, 0.99) * 1e3);
            }
            for (of, (session, process)) in contestants.iter().enumerate() {
                let many = searcher.many(session, process.id()).await;
                measured[2][of].push(many.rate);
                measured[3][of].push(many.processor_us);
            }
        }
        report.section(form.key(), "bare");
        for ((what, unit), [server, bare]) in FIGURES.into_iter().zip(measured) {
            report.compare(what, median(server), median(bare), unit);
        }
    }
    report
}
