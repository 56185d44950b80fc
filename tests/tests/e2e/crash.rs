//! A server that is killed repeatedly under its writers restarts with each acknowledged mutation, once, at the
//! acknowledged revision.

use std::path::Path;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use wayfold_tests::{Process, ServerProcess, Signal};

use crate::{
    clients::{Clients, FaultTime, Load},
    shared::command,
};

/// The number of kills, unless the environment variable `CRASH_KILLS` sets another.
const KILLS: u64 = 20;
const SEED: u64 = 3;
const LOAD: Load = Load {
    rows: 20,
    heavy: 0.02,
    removals: 0.2,
};
/// The minimum number of lines that a starting server logs: it opened the log, replayed an index, replayed all, and
/// serves.
const LINES: u32 = 4;

fn start(data: &Path) -> Process {
    Process::spawn(&mut command(data, "127.0.0.1:0"))
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_server_that_is_killed_comes_back_with_all_that_it_acknowledged() {
    println!("seed {SEED}");
    let directory = tempfile::tempdir().unwrap();
    let data = directory.path().join("data");
    let mut random = ChaCha8Rng::seed_from_u64(SEED);
    let mut server = ServerProcess::ready(start(&data));
    let mut clients = Clients::new(&server, SEED, LOAD).await;
    let target = std::env::var("CRASH_KILLS").map_or(KILLS, |kills| kills.parse().unwrap());
    let (mut kills, mut starting) = (0, 0);
    while kills < target {
        let moment = match random.random_range(0..4) {
            0 => FaultTime::Built(random.random_range(1..50)),
            _ => FaultTime::Acknowledged(random.random_range(1..150)),
        };
        clients.work(server, moment).await;
        kills += 1;
        // Some starts are killed too, after a random number of log lines.
        while kills < target && random.random_bool(0.4) {
            start(&data).kill_at_line(random.random_range(0..LINES));
            kills += 1;
            starting += 1;
        }
        server = ServerProcess::ready(start(&data));
        clients.check(&server).await;
    }
    server.stop(Signal::Terminate);
    println!(
        "{kills} kills, {starting} of them of a starting server; {}",
        clients.tally()
    );
}
