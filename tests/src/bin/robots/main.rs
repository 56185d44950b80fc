//! Measures the server over Zenoh, a bare queryable that answers the same bytes, and the search by itself.
//!
//!     cargo run --release -p wayfold-tests --bin robots -- [--points 50000] [--rounds 5]
//!
//! It starts the server in a process of its own, inserts SE(3) points (`R3*SO3:0.15`), and asks for ten neighbours of
//! one state: with one query in flight, and with 64. The bare queryable answers what the server might, without looking
//! at the query: its rate is the limit that Zenoh sets. All share one machine.

mod asking;
mod bare;

use std::{env, fmt, process::Command, process::ExitCode};

use clap::Parser;
use wayfold_index::{Forest, ForestOptions, PointRef, Points, Search, Space};
use wayfold_proto::v1::InsertRequest;
use wayfold_tests::{
    Process, ServerProcess, States, Stubs,
    figures::{median, quantile_ms, thread_time},
    measuring::connect,
    row_states,
};

use asking::{Asker, Form, Many, One};

/// The server's own allocator, so that the measured program equals the shipped one; all contestants share it.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

/// Which of the processes this is; unset in the one that measures.
const ROLE: &str = "ROBOTS_ROLE";
const SPACE: &str = "R3*SO3:0.15";
const INDEX: &str = "arm";
const WIDTH: usize = 7;
const K: u32 = 10;
const BATCH: usize = 1_000;
/// Searches by which one is measured.
const SEARCHES: usize = 20_000;

/// Measures the server over Zenoh, and a bare queryable for comparison.
#[derive(Debug, Parser)]
#[command(name = "robots")]
struct Arguments {
    /// How many points to insert.
    #[arg(long, default_value_t = 50_000)]
    points: usize,
    /// How often each is measured; the medians are reported.
    #[arg(long, default_value_t = 5)]
    rounds: usize,
}

fn main() -> ExitCode {
    match env::var(ROLE).as_deref() {
        Ok("server") => return wayfold_server::main(),
        Ok("bare") => return bare::main(),
        _ => {}
    }
    let arguments = Arguments::parse();
    let runtime = tokio::runtime::Runtime::new().expect("a runtime");
    runtime.block_on(measure(&arguments));
    ExitCode::SUCCESS
}

/// Starts this program in another role; where it listens for Zenoh.
fn start(role: &str) -> (ServerProcess, String) {
    let program = env::current_exe().expect("this program");
    let mut command = Command::new(program);
    command
        .env(ROLE, role)
        .args(["--grpc", "127.0.0.1:0", "--data", "memory"])
        .args(["--zenoh", "tcp/127.0.0.1:0", "--log", "warn"]);
    let mut server = ServerProcess::ready(Process::spawn(&mut command));
    let locator = server.zenoh();
    (server, locator)
}

async fn measure(arguments: &Arguments) {
    let space: Space = SPACE.parse().expect("a space");
    let rows = States::new(space.clone(), 1).rows(arguments.points);
    let ((server, at_server), (bare, at_bare)) = (start("server"), start("bare"));
    let mut stubs = Stubs::connect(server.uri()).await;
    stubs.create(INDEX, SPACE).await;
    for rows in rows.chunks(BATCH * WIDTH) {
        let request = InsertRequest {
            index: INDEX.into(),
            states: Some(row_states(rows, WIDTH)),
            ..Default::default()
        };
        stubs.insert(request).await;
    }
    let search_us = search_us(&space, &rows);
    println!(
        "{SPACE}, {} points, k = {K}: a search in process takes {search_us:.1} us",
        arguments.points
    );

    let (to_server, to_bare) = (connect(&at_server).await, connect(&at_bare).await);
    for form in [Form::Protobuf, Form::Json] {
        let mut figures = Figures::default();
        for round in 0..arguments.rounds.max(1) {
            let asker = Asker::new(&space, form, round as u64);
            // The contestants take turns, so that other load on the machine affects both.
            figures.one.0.push(asker.one(&to_server).await);
            figures.one.1.push(asker.one(&to_bare).await);
            figures
                .many
                .0
                .push(asker.many(&to_server, server.process().id()).await);
            figures
                .many
                .1
                .push(asker.many(&to_bare, bare.process().id()).await);
        }
        figures.search_us = search_us;
        println!("\n{form:?}\n{figures}");
    }
}

/// Processor time of a search in this process, in microseconds.
fn search_us(space: &Space, rows: &[f64]) -> f64 {
    let mut points = Points::new(space.coordinates());
    let mut rows = rows.to_vec();
    for (id, row) in (0..).zip(rows.chunks_mut(WIDTH)) {
        space.canonicalize(row).expect("a state");
        let (tag, revision) = (0, 1);
        points.push_point(PointRef {
            id,
            tag,
            revision,
            row,
        });
    }
    let mut forest = Forest::new(space.clone(), ForestOptions::for_space(space));
    forest.apply(1, &points, &[]).expect("canonical states");
    forest.settle();
    let mut asked = States::new(space.clone(), 2).rows(SEARCHES);
    let search = Search::nearest_k(K as usize);
    let before = thread_time();
    for row in asked.chunks_mut(WIDTH) {
        space.canonicalize(row).expect("a state");
        assert_eq!(
            forest
                .search(row, &search)
                .expect("canonical states")
                .neighbors
                .len(),
            K as usize
        );
    }
    (thread_time() - before).as_secs_f64() * 1e6 / SEARCHES as f64
}

/// The measurements of the server and of the bare queryable.
#[derive(Default)]
struct Figures {
    one: (Vec<One>, Vec<One>),
    many: (Vec<Many>, Vec<Many>),
    search_us: f64,
}

impl fmt::Display for Figures {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let quantile = |of: &[One], q: f64| {
            let quantiles = of.iter().map(|one| quantile_ms(&one.0, q) * 1e3);
            median(quantiles.collect())
        };
        let line = |f: &mut fmt::Formatter<'_>, what: &str, (server, bare): (f64, f64)| {
            writeln!(
                f,
                "{what:<34}{server:>10.1}{bare:>10.1}{:>8.2}",
                server / bare
            )
        };
        writeln!(f, "{:<34}{:>10}{:>10}{:>8}", "", "server", "bare", "ratio")?;
        let p50 = (quantile(&self.one.0, 0.5), quantile(&self.one.1, 0.5));
        line(f, "one in flight, p50 us", p50)?;
        let p99 = (quantile(&self.one.0, 0.99), quantile(&self.one.1, 0.99));
        line(f, "one in flight, p99 us", p99)?;
        let beyond = p50.0 - p50.1 - self.search_us;
        writeln!(f, "  p50 beyond bare and search, us   {beyond:>11.1}")?;
        let rate = |of: &[Many]| median(of.iter().map(|many| many.rate).collect());
        let rates = (rate(&self.many.0), rate(&self.many.1));
        line(f, "64 in flight, answers/s", rates)?;
        let cpu = |of: &[Many]| median(of.iter().map(|many| many.processor_us).collect());
        let cpu = (cpu(&self.many.0), cpu(&self.many.1));
        line(f, "  processor time of it an answer, us", cpu)?;
        let reached = (cpu.1 + self.search_us) / cpu.0;
        writeln!(f, "  of 1 / (bare's and the search)   {reached:>11.2}")
    }
}
