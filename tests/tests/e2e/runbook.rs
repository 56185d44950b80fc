//! The steps of the runbook of docs/cluster.md that no other test takes. The environment variable `NATS_SERVER` has the path of
//! the program nats-server.

use std::{
    collections::BTreeMap,
    fs,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering::Relaxed},
    },
};

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use tokio::{task, time::timeout};
use tonic::Code;
use wayfold::{Client, Index};
use wayfold_proto::v1::{CreateIndexRequest, create_index_request::SpaceForm};
use wayfold_tests::{Content, Signal, Stubs, insert_request, page};

use crate::{
    healing::{latest_content, together, wait_until_joined},
    journal_loss::{Cluster, MAX_WAIT, insert, insert_until_acknowledged},
    metrics::figures,
};

const SERVERS: usize = 3;
const POINTS: u64 = 20;

/// Stops and starts the servers in turn while a client calls; no call fails. With `replaces`, each server starts on an empty
/// directory.
async fn roll(replaces: bool) {
    let cluster = Cluster::empty();
    let mut servers = Vec::from(together::<SERVERS>(&cluster, &[]));
    let mut stubs = Stubs::connect(servers[0].uri()).await;
    stubs.create("arm", "R1").await;
    let mut written = 0;
    for number in 0..SERVERS {
        let server = servers.remove(0);
        let mut uris = vec![server.uri()];
        uris.extend(servers.iter().map(|other| other.uri()));
        let client = Client::connect(&uris.join(",")).await.unwrap();
        let index = client.index("arm").await.unwrap();
        let stopping = task::spawn_blocking(move || server.stop(Signal::Terminate));
        let mut without = 0;
        while without < POINTS {
            without += u64::from(stopping.is_finished());
            index.insert([[written as f64]]).await.unwrap();
            written += 1;
        }
        let stopped = stopping.await.unwrap();
        assert!(stopped.status.success(), "{}", stopped.stderr);
        if replaces {
            cluster.lose(number);
        }
        let server = cluster.start(number);
        let client = Client::connect(server.uri()).await.unwrap();
        let serving = async { while !client.is_serving().await.unwrap() {} };
        timeout(MAX_WAIT, serving).await.unwrap();
        servers.push(server);
    }
    for server in &servers {
        let mut stubs = Stubs::connect(server.uri()).await;
        let content = latest_content(&mut stubs).await;
        assert_eq!(content.points.len() as u64, written);
    }
}

#[ignore = "needs nats-server"]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn servers_are_upgraded_one_after_the_other_under_a_client() {
    roll(false).await;
}

#[ignore = "needs nats-server"]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn servers_are_replaced_one_after_the_other_under_a_client() {
    roll(true).await;
}

/// Grows a tree into the unit square until this many vertices were added after the kills. Returns the states by id.
fn grow(index: &Index, is_over: &AtomicBool) -> BTreeMap<u64, [f64; 2]> {
    let mut random = ChaCha8Rng::seed_from_u64(1);
    let root = [0.5, 0.5];
    let mut tree = BTreeMap::from([(index.insert(root).unwrap(), root)]);
    let mut after = 0;
    while after < POINTS {
        after += u64::from(is_over.load(Relaxed));
        let sample: [f64; 2] = [random.random(), random.random()];
        let nearest = index.nearest(sample).unwrap().unwrap();
        let from = tree[&nearest.id];
        let vertex = [0, 1].map(|axis| from[axis] + 0.1 * (sample[axis] - from[axis]));
        tree.insert(index.insert(vertex).unwrap(), vertex);
    }
    index.flush().unwrap();
    tree
}

/// Two of three servers are killed, one after the other, while a planner runs. No call of the planner fails, and the last
/// server has each vertex as the planner has it.
#[ignore = "needs nats-server"]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_planner_goes_on_while_servers_are_killed() {
    let cluster = Cluster::empty();
    let mut servers = Vec::from(together::<SERVERS>(&cluster, &[]));
    let uris: Vec<_> = servers.iter().map(|server| server.uri()).collect();
    let index = Index::shared(&uris.join(","), "arm").create(&"R2".parse().unwrap());
    let index = index.max_pending_bytes(1 << 18).timeout(MAX_WAIT);
    let index = task::spawn_blocking(|| index.open().unwrap());
    let index = index.await.unwrap();
    let is_over = Arc::new(AtomicBool::new(false));
    let watched = Arc::clone(&is_over);
    let planning = task::spawn_blocking(move || grow(&index, &watched));
    let last = servers.pop().unwrap();
    let mut stubs = Stubs::connect(last.uri()).await;
    stubs.find("arm").await;
    for killed in servers {
        let has = stubs.describe("arm").await.point_count;
        let grown = async { while stubs.describe("arm").await.point_count < has + 10 * POINTS {} };
        timeout(MAX_WAIT, grown).await.unwrap();
        assert!(!planning.is_finished());
        killed.stop(Signal::Kill);
    }
    is_over.store(true, Relaxed);
    let tree = planning.await.unwrap();
    let content = latest_content(&mut stubs).await;
    let stored = content.points.iter().map(|(id, point)| {
        let state = [0, 1].map(|axis| f64::from_bits(point.state[axis]));
        (*id, state)
    });
    assert!(stored.eq(tree));
}

/// Some of the indices belong to the server whose memory is above its watermark.
#[ignore = "needs nats-server"]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn inserts_go_on_while_the_memory_of_their_owner_is_full() {
    let cluster = Cluster::empty();
    let full = [
        ("WAYFOLD_MEMORY__LIMIT_BYTES", "1000000000"),
        ("WAYFOLD_MEMORY__HIGH_PERCENT", "1"),
        ("WAYFOLD_MEMORY__LOW_PERCENT", "1"),
    ];
    let mut servers = [cluster.start_with(0, &full), cluster.start(1)];
    wait_until_joined(&mut servers);
    let pages = servers[0].pages();
    let [full, other] = &servers;
    let (mut refusing, mut stubs) = (
        Stubs::connect(full.uri()).await,
        Stubs::connect(other.uri()).await,
    );
    let insert = |index: &str| insert_request(index, &[0.5], 1);
    for number in 0..16 {
        let index = format!("arm-{number}");
        stubs.create(&index, "R1").await;
        refusing.find(&index).await;
        stubs.insert(insert(&index)).await;
    }
    let refused = refusing.points.insert(insert("arm-0")).await;
    let owns = figures(&pages)["wayfold_index_owned{index=\"arm-0\"}"] == 1.0;
    assert_eq!(refused.is_err(), owns, "{refused:?}");
}

/// Asserts that a server refuses to insert a point of this id and to create an index, and reads the points before.
async fn only_read(stubs: &mut Stubs, id: u64) {
    let inserted = insert(stubs, id).await.unwrap_err();
    let create = CreateIndexRequest {
        name: "leg".into(),
        space_form: Some(SpaceForm::SpaceText("R1".into())),
        ..Default::default()
    };
    let created = stubs.indexes.create_index(create).await.unwrap_err();
    for refused in [&inserted, &created] {
        assert_eq!(refused.code(), Code::Unavailable, "{refused}");
    }
    let reasons = ["NATS does not answer", "the answer to the record"];
    let is_named = reasons.iter().any(|why| inserted.message().contains(why));
    assert!(is_named, "{inserted}");
    let content = Content::read(stubs, "arm").await.unwrap();
    assert!(content.points.keys().copied().eq(0..POINTS));
}

#[ignore = "needs nats-server"]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn reads_go_on_without_two_of_three_servers_of_nats_and_writes_say_why() {
    let mut cluster = Cluster::with_nats(3);
    let [first, second] = together(&cluster, &[]);
    let mut stubs = [
        Stubs::connect(first.uri()).await,
        Stubs::connect(second.uri()).await,
    ];
    stubs[0].create("arm", "R1").await;
    stubs[1].find("arm").await;
    insert_until_acknowledged(&mut stubs[0], 0..POINTS).await;
    latest_content(&mut stubs[1]).await;
    for node in [1, 2] {
        cluster.nats.kill(node);
    }
    let [one, other] = &mut stubs;
    tokio::join!(only_read(one, POINTS), only_read(other, POINTS + 1));

    cluster.nats.restart(1);
    for (stubs, id) in stubs.iter_mut().zip(POINTS..) {
        let written = insert_until_acknowledged(stubs, id..id + 1);
        timeout(MAX_WAIT, written).await.unwrap();
    }
    for stubs in &mut stubs {
        let content = latest_content(stubs).await;
        assert!(content.points.keys().copied().eq(0..POINTS + 2));
    }
}

#[ignore = "needs nats-server"]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_lost_server_of_nats_is_replaced_by_an_empty_one() {
    let mut cluster = Cluster::with_nats(3);
    let server = cluster.start(0);
    let mut stubs = Stubs::connect(server.uri()).await;
    stubs.create("arm", "R1").await;
    insert_until_acknowledged(&mut stubs, 0..POINTS).await;
    cluster.nats.kill(1);
    fs::remove_dir_all(cluster.nats.store(1)).unwrap();
    let written = insert_until_acknowledged(&mut stubs, POINTS..2 * POINTS);
    timeout(MAX_WAIT, written).await.unwrap();
    let log = cluster.nats.restart(1);
    let address = log
        .iter()
        .find_map(|line| line.split_once("Starting http monitor on "));
    let (_, address) = address.unwrap();
    let healthy = async {
        while page(address, "/healthz", "").0 != 200 {
            tokio::task::yield_now().await;
        }
    };
    timeout(MAX_WAIT, healthy).await.unwrap();

    // The other one would not suffice.
    cluster.nats.kill(0);
    let written = insert_until_acknowledged(&mut stubs, 2 * POINTS..3 * POINTS);
    timeout(MAX_WAIT, written).await.unwrap();
    let content = latest_content(&mut stubs).await;
    assert!(content.points.keys().copied().eq(0..3 * POINTS));
}

/// The connections of a server of NATS that stands still stay open. The server that is connected to it goes on at another.
#[ignore = "needs nats-server"]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn writes_go_on_while_a_server_of_nats_stands_still() {
    let cluster = Cluster::with_nats(3);
    let server = cluster.start(0);
    let mut stubs = Stubs::connect(server.uri()).await;
    stubs.create("arm", "R1").await;
    // One of them is the one to which the server is connected.
    for node in 0..3 {
        cluster.nats.signal(node as usize, Signal::Pause);
        let written = insert_until_acknowledged(&mut stubs, node * POINTS..(node + 1) * POINTS);
        let written = timeout(MAX_WAIT, written).await;
        cluster.nats.signal(node as usize, Signal::Resume);
        assert!(
            written.is_ok(),
            "nothing is written while {node} stands still"
        );
    }
}
