//! A shared index keeps its writes despite failures of its server and of the connection: each write is there
//! exactly once, in the order of the calls.

mod asleep;
mod checks;
mod failover;
mod history;
mod killed_planner;
mod outage;
pub(crate) mod proxy;
mod roadmap;
mod silent;

use std::{
    path::Path,
    process::Command,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering::Relaxed},
    },
    thread,
    time::Duration,
};

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use wayfold::{ConnectionStatus, Index};
use wayfold_index::Space;
use wayfold_tests::{Process, ServerProcess, Signal};

use checks::{check_all, check_revisions, wait_for_status};
use history::{History, check_meanwhile, content, start_writers, store_common};
use proxy::Proxy;

const SPACE: &str = "R2*SO2*SO3:0.15";

/// The number of kills, unless the environment variable `SHARED_KILLS` sets another.
const KILLS: u64 = 10;
const SEED: u64 = 18;
/// The minimum number of lines that a starting server logs.
const LINES: u32 = 4;

/// A server on disk whose first tree is so small that a merge is nearly always under way.
pub(crate) fn command(data: &Path, address: &str) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_server-process"));
    command
        .args(["--grpc", address, "--data"])
        .arg(data)
        .env("WAYFOLD_INDEX__GROWING_ROWS", "32");
    command
}

/// A shared index that waits for its server without a limit.
fn shared(uri: &str, space: &Space) -> Index {
    let index = Index::shared(uri, "arm").create(space);
    index.timeout(Duration::from_secs(120)).open().unwrap()
}

#[test]
fn every_write_is_there_once_after_kills() {
    println!("seed {SEED}");
    let kills = std::env::var("SHARED_KILLS").map_or(KILLS, |kills| kills.parse().unwrap());
    let directory = tempfile::tempdir().unwrap();
    let data = directory.path().join("data");
    let space: Space = SPACE.parse().unwrap();
    let mut random = ChaCha8Rng::seed_from_u64(SEED);
    let mut server = ServerProcess::ready(Process::spawn(&mut command(&data, "127.0.0.1:0")));
    let uri = server.uri().to_owned();
    // Every later server has the address of the first.
    let address = uri.strip_prefix("http://").unwrap();
    let start = || Process::spawn(&mut command(&data, address));

    let runtime = tokio::runtime::Runtime::new().unwrap();
    let shaky = runtime.block_on(Proxy::to(&uri));
    let common = store_common(&shared(&uri, &space), SEED);
    let reader = shared(&shaky.uri, &space);
    let indexes = [&uri, &uri, &shaky.uri].map(|uri| shared(uri, &space));
    let (turns, writers) = start_writers(&indexes);
    let done = Arc::new(AtomicBool::new(false));
    let comparers: Vec<thread::JoinHandle<u64>> = [&reader, &indexes[0]]
        .into_iter()
        .map(|index| {
            let (index, done) = (index.clone(), Arc::clone(&done));
            thread::spawn(move || check_meanwhile(&index, &done, SEED))
        })
        .collect();
    let write = |count: u64| {
        for _ in 0..count {
            turns.recv().expect("a writer");
        }
    };
    let (mut of_reader, mut of_writer) = (Vec::new(), Vec::new());
    let (mut killed, mut starting) = (0, 0);
    while killed < kills {
        write(random.random_range(1..200));
        // The cut falls into the middle of a message.
        shaky.cut_after(random.random_range(0..20_000));
        // Without this the kill finds the first writes after the last start.
        if random.random_bool(0.5) {
            indexes[0].flush().unwrap();
            write(random.random_range(1..50));
        }
        server.stop(Signal::Kill);
        killed += 1;
        write(random.random_range(0..200));
        wait_for_status(&reader, |status| {
            matches!(status, ConnectionStatus::Disconnected { .. })
        });
        of_reader.push(content(&reader));
        // Some starts are killed too, after a random number of log lines.
        while killed < kills && random.random_bool(0.3) {
            start().kill_at_line(random.random_range(0..LINES));
            killed += 1;
            starting += 1;
        }
        server = ServerProcess::ready(start());
        of_writer.push(content(&indexes[0]));
    }
    drop(turns);
    let histories: Vec<History> = writers.into_iter().map(|w| w.join().unwrap()).collect();
    done.store(true, Relaxed);
    let compared = comparers.into_iter().map(|it| it.join().unwrap());
    let compared: Vec<u64> = compared.collect();
    assert!(compared.iter().all(|count| *count > kills), "{compared:?}");
    let fresh = shared(&uri, &space);
    let copies: Vec<&Index> = [&fresh, &reader].into_iter().chain(&indexes).collect();
    check_all(&copies, || shared(&uri, &space), &common, &histories);
    for history in &histories {
        history.check_prefixes(&of_reader);
    }
    for history in &histories[1..] {
        history.check_prefixes(&of_writer);
    }
    runtime.block_on(check_revisions(&uri, &of_reader));
    server.stop(Signal::Terminate);
    println!(
        "{killed} kills, {starting} of them of a starting server; {} cuts; {compared:?} answers compared",
        shaky.cuts()
    );
}
