//! Measures inserts that request the neighbours of the inserted states, 64 at a time, without the network. They show the
//! parallelism of inserts although an index has only one writer.
//!
//!     cargo run --release -p wayfold-tests --bin writers -- [--rounds 5] [--json FILE]

use std::{path::PathBuf, process::ExitCode, sync::Arc, time::Instant};

use clap::Parser;
use serde_json::{Value, json};
use tokio::task::JoinSet;
use wayfold_proto::v1::{CreateIndexRequest, InsertRequest, create_index_request::SpaceForm};
use wayfold_server::{
    log::MemoryLog,
    registry::{Registry, RegistryOptions},
    service::{Call, Limits, Service},
};
use wayfold_tests::{
    States,
    figures::{median, processor_seconds},
    k_nearest, measuring, row_states,
};

/// The server's own allocator, so that the measured program equals the shipped one.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

const INDEX: &str = "load";
const SPACE: &str = "R3*SO3:0.15";
const WIDTH: usize = 7;
const K: u32 = 10;
/// The number of concurrent inserts.
const WRITERS: usize = 64;
/// The numbers of states in one call.
const BATCHES: [usize; 2] = [1, 100];
/// The number of initial points, and of inserted ones.
const POINTS: usize = 50_000;

/// Measures inserts that request neighbours, 64 at a time, without the network.
#[derive(Debug, Parser)]
#[command(name = "writers")]
struct Arguments {
    /// The number of rounds; the medians are reported.
    #[arg(long, default_value_t = 5)]
    rounds: usize,
    /// Writes the figures to a file, as JSON.
    #[arg(long)]
    json: Option<PathBuf>,
}

fn main() -> ExitCode {
    measuring::main(async |arguments: Arguments| {
        let rounds = arguments.rounds.max(1);
        let mut batches = Vec::new();
        for batch in BATCHES {
            let mut measured = Vec::new();
            for round in 0..rounds as u64 {
                measured.push(write(batch, round).await);
            }
            batches.push(figures(batch, &measured));
        }
        let figures = json!({ "rounds": rounds, "batches": batches });
        println!("{figures:#}");
        (figures, arguments.json)
    })
}

/// The medians of one batch size.
fn figures(batch: usize, rounds: &[WriterRates]) -> Value {
    let of = |part: fn(&WriterRates) -> f64| median(rounds.iter().map(part).collect());
    json!({
        "batch": batch,
        "states_per_second": of(|written| written.rate),
        "processors": of(|written| written.processors),
    })
}

/// The result of one measurement.
#[derive(Clone, Copy, Debug)]
struct WriterRates {
    /// States inserted per second.
    rate: f64,
    /// The average number of used processors.
    processors: f64,
}

/// Inserts into an index in memory, `batch` states per call. Each call requests the ten nearest neighbours of each state.
async fn write(batch: usize, round: u64) -> WriterRates {
    let registry = Registry::new(Arc::new(MemoryLog::new()), RegistryOptions::default());
    registry.replay().expect("an empty log");
    let service = Service::new(registry, Limits::default());
    service.set_ready();
    let request = CreateIndexRequest {
        name: INDEX.into(),
        space_form: Some(SpaceForm::SpaceText(SPACE.into())),
        ..Default::default()
    };
    let created = service.create_index(&Call::default(), request).await;
    created.expect("an index");
    let mut states = States::new(SPACE.parse().expect("a space"), 50 + round);
    for _ in 0..POINTS / 1_000 {
        insert(&service, &states.rows(1_000), false).await;
    }
    let of_each: Vec<_> = (0..WRITERS)
        .map(|_| states.rows(POINTS / WRITERS / batch * batch))
        .collect();
    let inserted: usize = of_each.iter().map(|rows| rows.len() / WIDTH).sum();

    let (started, processor) = (Instant::now(), processor());
    let mut writers = JoinSet::new();
    for rows in of_each {
        let service = service.clone();
        writers.spawn(async move {
            for rows in rows.chunks(batch * WIDTH) {
                insert(&service, rows, true).await;
            }
        });
    }
    writers.join_all().await;
    let seconds = started.elapsed().as_secs_f64();
    WriterRates {
        rate: inserted as f64 / seconds,
        processors: (self::processor() - processor) / seconds,
    }
}

async fn insert(service: &Service, rows: &[f64], with_neighbors: bool) {
    let request = InsertRequest {
        index_name: INDEX.into(),
        states: Some(row_states(rows, WIDTH)),
        neighbor_spec: with_neighbors.then(|| k_nearest(K)),
        ..Default::default()
    };
    let inserted = service.insert(&Call::default(), request).await;
    assert_eq!(inserted.expect("an insert").ids.len(), rows.len() / WIDTH);
}

/// Processor time of this process.
fn processor() -> f64 {
    processor_seconds(std::process::id()).unwrap_or(f64::NAN)
}
