//! Writers over Zenoh and over gRPC grow one index while its server and the router are killed.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use wayfold::{ConnectionStatus, Index};
use wayfold_index::Space;
use wayfold_tests::Signal;

use super::{
    checks::{check_all, check_revisions, wait_for_status},
    history::{History, content, start_writers, store_common},
    proxy::Proxy,
    shared,
};
use crate::robot::{Robot, router, server_behind};

const SPACE: &str = "R2*SO2*SO3:0.15";
const SEED: u64 = 18;
const KILLS: u64 = 8;

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn every_write_is_there_once_after_kills_of_server_and_router() {
    let directory = tempfile::tempdir().unwrap();
    let data = directory.path().join("data");
    let data = ["--data", data.to_str().unwrap()];
    let space: Space = SPACE.parse().unwrap();
    let mut random = ChaCha8Rng::seed_from_u64(SEED);
    let (mut router_process, at) = router("tcp/127.0.0.1:0");
    let start = || server_behind(&at, &data, &[("WAYFOLD_INDEX__GROWING_ROWS", "32")]);
    let mut server = start();

    let way = Proxy::to(server.uri()).await;
    let robots = [Robot::connect(&at).await, Robot::connect(&at).await];
    let common = store_common(&shared(&robots[0], &space), SEED);
    let reader = shared(&robots[1], &space);
    let over_grpc = Index::shared(&way.uri, "arm").open().unwrap();
    let indexes = [
        shared(&robots[0], &space),
        shared(&robots[1], &space),
        over_grpc,
    ];
    let (turns, writers) = start_writers(&indexes);
    let write = |count: u64| {
        for _ in 0..count {
            turns.recv().expect("a writer");
        }
    };
    let mut of_reader = Vec::new();
    let mut outage = |random: &mut ChaCha8Rng| {
        write(random.random_range(1..200));
        wait_for_status(&reader, |status| {
            matches!(status, ConnectionStatus::Disconnected { .. })
        });
        of_reader.push(content(&reader));
    };
    for kill in 0..KILLS {
        write(random.random_range(1..200));
        if random.random_bool(0.5) {
            indexes[0].flush().unwrap();
        }
        if kill % 3 == 2 {
            router_process.stop(Signal::Kill);
            outage(&mut random);
            router_process = router(&at).0;
        } else {
            server.stop(Signal::Kill);
            outage(&mut random);
            server = start();
            way.lead_to(server.uri());
        }
    }
    drop(turns);
    let histories: Vec<History> = writers.into_iter().map(|w| w.join().unwrap()).collect();

    let fresh = shared(&robots[0], &space);
    let copies: Vec<&Index> = [&fresh, &reader].into_iter().chain(&indexes).collect();
    check_all(&copies, || shared(&robots[1], &space), &common, &histories);
    for history in &histories {
        history.check_prefixes(&of_reader);
    }
    check_revisions(&way.uri, &of_reader).await;
}
