//! The latency for one client with one state in flight.

use std::time::{Duration, Instant};

use wayfold_tests::{
    States, Stubs,
    figures::{median, quantile_ms},
    measuring,
    report::{Goal, Report},
};

use crate::{
    INDEX, SPACE, WIDTH,
    base_directory::{AppendFile, BaseDirectory},
    service::insertion,
    shape::Shape,
};

const CALLS: usize = 1_000;

pub(crate) async fn measure(
    base: &BaseDirectory,
    shape: &Shape,
    rounds: usize,
    report: &mut Report,
) {
    let directory = base.create();
    let data = directory.path().join("data").to_string_lossy().into_owned();
    let (server, echo) = (measuring::server(&data), measuring::echo());
    let (mut ours, echo) = (
        Stubs::connect(server.uri()).await,
        Stubs::connect(echo.uri()).await,
    );
    ours.create(INDEX, SPACE).await;
    let mut file = AppendFile::new(directory.path());
    let bytes = vec![0; shape.bytes()];
    let mut rounds_of = [Vec::new(), Vec::new(), Vec::new()];
    for round in 0..rounds {
        let appends = (0..CALLS).map(|_| file.append(&bytes)).collect();
        rounds_of[0].push(quantile_of(appends));
        rounds_of[1].push(quantile_of(call(&echo, round).await));
        rounds_of[2].push(quantile_of(call(&ours, round).await));
    }
    let [append, rpc, insert] = rounds_of.map(median);
    report.section(
        "one client, one state in flight, fsync: median latency",
        "2 appends + RPC",
    );
    report.note("append of the same bytes and fdatasync", append, "ms");
    report.note("bare RPC, an echo of the same messages", rpc, "ms");
    report.ratio(
        "Insert",
        insert,
        2.0 * append + rpc,
        "ms",
        Goal::AtMost(1.0),
    );
}

async fn call(stubs: &Stubs, round: usize) -> Vec<Duration> {
    let mut stubs = stubs.clone();
    let rows = States::new(SPACE.parse().expect("a space"), round as u64).rows(CALLS);
    let mut taken = Vec::with_capacity(CALLS);
    for row in rows.chunks_exact(WIDTH) {
        let request = insertion(row, None);
        let began = Instant::now();
        stubs.insert(request).await;
        taken.push(began.elapsed());
    }
    taken
}

fn quantile_of(mut taken: Vec<Duration>) -> f64 {
    taken.sort();
    quantile_ms(&taken, 0.5)
}
