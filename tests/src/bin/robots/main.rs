//! Measures the server over Zenoh, and a bare queryable that answers the same bytes.
//!
//!     cargo run --release -p wayfold-tests --bin robots -- [--points 50000] [--rounds 5] [--json FILE]
//!
//! It starts the server in a separate process, inserts SE(3) points (`R3*SO3:0.15`), and searches ten neighbours of one
//! state, with one query in flight and with 64. The bare queryable returns a typical answer of the server without
//! reading the query: its rate is the limit that Zenoh sets. All share one machine.

mod bare;
mod report;
mod searcher;

use std::{path::PathBuf, process::ExitCode};

use clap::Parser;
use wayfold_index::Space;
use wayfold_proto::v1::InsertRequest;
use wayfold_tests::{States, Stubs, measuring, row_states};

use report::{Report, Rounds};
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
        print!("{report}");
        (report.to_json(), arguments.json)
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
        let request = InsertRequest {
            index_name: INDEX.into(),
            states: Some(row_states(rows, WIDTH)),
            ..Default::default()
        };
        stubs.insert(request).await;
    }
    let rounds = arguments.rounds.max(1);
    let mut report = Report {
        points: arguments.points,
        rounds,
        forms: Vec::new(),
    };
    let to_server = measuring::connect(&server.zenoh()).await;
    let to_bare = measuring::connect(&bare.zenoh()).await;
    for form in [Form::Protobuf, Form::Json] {
        let mut measured = Rounds::default();
        for round in 0..rounds {
            let asker = Searcher::new(&space, form, round as u64);
            // The contestants take turns, so that other load on the machine affects both.
            measured.one.0.push(asker.one(&to_server).await);
            measured.one.1.push(asker.one(&to_bare).await);
            let (server, bare) = (server.process().id(), bare.process().id());
            measured.many.0.push(asker.many(&to_server, server).await);
            measured.many.1.push(asker.many(&to_bare, bare).await);
        }
        report.forms.push((form, measured));
    }
    report
}
