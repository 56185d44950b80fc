//! Several servers with one journal in NATS: a client goes on at another one when its server dies, or is cut off from
//! NATS. The environment variable `NATS_SERVER` has the path of the program nats-server.

use std::{collections::BTreeSet, thread, time::Duration};

use tokio::runtime::Runtime;
use wayfold::{Client, Code, ConnectionStatus, Index, ResetReason, Revision, WatchEvent};
use wayfold_index::Space;
use wayfold_proto::v1::GetRequest;
use wayfold_tests::{ServerProcess, Signal, Stubs, server};

use super::{
    checks::wait_for_status,
    history::{check_copies, content, wait_for_all},
    proxy::Proxy,
    shared,
};
use crate::journal_loss::Cluster;

const POINTS: usize = 300;

/// The address of the only server of NATS, as a proxy takes it.
fn nats_uri(cluster: &Cluster) -> String {
    cluster.nats.urls().replace("nats://", "http://")
}

/// Two servers that keep their data in memory. The second one reaches NATS through a proxy.
struct TwoServers {
    runtime: Runtime,
    way: Proxy,
    first: ServerProcess,
    second: ServerProcess,
    uris: String,
    cluster: Cluster,
}

impl TwoServers {
    fn start() -> TwoServers {
        let cluster = Cluster::empty();
        let runtime = Runtime::new().unwrap();
        let way = runtime.block_on(Proxy::to(&nats_uri(&cluster)));
        let memory = ("WAYFOLD_DATA__DIR", "memory");
        let first = cluster.start_with(0, &[memory]);
        let through = way.uri.replace("http://", "nats://");
        let second = cluster.start_with(1, &[memory, ("WAYFOLD_CLUSTER__NATS", &through)]);
        let uris = format!("{},{}", first.uri(), second.uri());
        TwoServers {
            runtime,
            way,
            first,
            second,
            uris,
            cluster,
        }
    }
}

/// Waits until a server knows the index that another one has created.
fn wait_for_index(uri: &str) {
    let runtime = Runtime::new().unwrap();
    runtime.block_on(async {
        let client = Client::connect(uri).await.unwrap();
        while client.index("arm").await.is_err() {
            tokio::task::yield_now().await;
        }
    });
}

/// Inserts one point a call, and returns the ids.
fn insert(index: &Index, first: usize) -> Vec<u64> {
    let numbers = first..first + POINTS;
    let inserted = numbers.map(|number| index.insert([number as f64, 0.0]).unwrap());
    inserted.collect()
}

#[test]
#[ignore = "needs nats-server"]
fn writes_of_a_copy_are_there_once_after_its_server_has_died() {
    let cluster = Cluster::empty();
    let [first, second] = [0, 1].map(|number| cluster.start(number));
    let space: Space = "R2".parse().unwrap();
    let uris = format!("{},{}", first.uri(), second.uri());
    let index = shared(&uris, &space);
    let reader = shared(&uris, &space);
    wait_for_index(second.uri());
    let mut ids = insert(&index, 0);
    // Some of the writes are under way.
    first.stop(Signal::Kill);
    ids.extend(insert(&index, POINTS));
    index.flush().unwrap();

    let stored = content(&shared(second.uri(), &space));
    assert_eq!(
        stored.keys().copied().collect::<BTreeSet<u64>>(),
        ids.iter().copied().collect()
    );
    let states: Vec<u64> = ids.iter().map(|id| stored[id].1[0]).collect();
    let expected = (0..2 * POINTS).map(|number| (number as f64).to_bits());
    assert_eq!(states, expected.collect::<Vec<u64>>());
    wait_for_all(&index, &[-1.0, 0.0], &[&reader, &index]);
    let stored = content(&shared(second.uri(), &space));
    check_copies(&stored, &space, &[&index, &reader]);
}

/// The second server hears nothing of NATS while the first one writes, and for a while after that has died.
#[test]
#[ignore = "needs nats-server"]
fn a_server_that_lags_is_not_older_to_its_client() {
    let TwoServers {
        runtime,
        way,
        first,
        second,
        uris,
        cluster,
    } = TwoServers::start();
    let space: Space = "R2".parse().unwrap();
    let copy = shared(&uris, &space);
    wait_for_index(second.uri());
    runtime.block_on(async {
        let client = Client::connect(&uris).await.unwrap();
        let index = client.index("arm").await.unwrap();
        way.hold(&nats_uri(&cluster));
        let mut ids = Vec::new();
        for number in 0..POINTS {
            let inserted = index.insert([[number as f64, 0.0]]).await.unwrap();
            ids.push(inserted.outcomes[0].id().unwrap());
        }
        let seen = index.revision();
        first.stop(Signal::Kill);

        // It has none of the points.
        let impatient = index.with_timeout(Duration::from_secs(2));
        let read = impatient.get(&ids[..]).await.unwrap_err();
        let updated = impatient.update([ids[0]]).tags([1]).await.unwrap_err();
        for error in [read, updated] {
            assert_eq!(error.code(), Code::DeadlineExceeded, "{error}");
        }
        way.lead_to(&nats_uri(&cluster));
        index.update([ids[0]]).tags([1]).await.unwrap();
        let removed = index.remove([ids[POINTS - 1]]).await.unwrap();
        assert_eq!(removed.removed_count, 1);
        let left = &ids[..POINTS - 1];
        assert_eq!(index.get(left).await.unwrap().ids(), left);
        let described = client.index_info("arm").await.unwrap();
        assert_eq!(described.point_count, left.len() as u64);
        assert!(described.revision.number > seen.number);
    });
    wait_for_all(&copy, &[-1.0, 0.0], &[&copy]);
    let stored = content(&shared(second.uri(), &space));
    check_copies(&stored, &space, &[&copy]);
}

/// The second server hears nothing of NATS while the index is made, maybe again, and for a while after the first one has
/// died.
fn makes_unheard(has_older: bool) {
    let TwoServers {
        runtime,
        way,
        first,
        second,
        uris,
        cluster,
    } = TwoServers::start();
    let space: Space = "R2".parse().unwrap();
    if has_older {
        drop(shared(first.uri(), &space));
        wait_for_index(second.uri());
    }
    way.hold(&nats_uri(&cluster));
    if has_older {
        runtime.block_on(async {
            let client = Client::connect(first.uri()).await.unwrap();
            client.delete_index("arm").await.unwrap();
        });
    }
    let copy = shared(&uris, &space);
    let mut ids = insert(&copy, 0);
    copy.flush().unwrap();
    first.stop(Signal::Kill);
    ids.extend(insert(&copy, POINTS));
    wait_for_status(&copy, |status| match status {
        ConnectionStatus::Disconnected { why, .. } => why.reason() == Some("UID_UNKNOWN"),
        _ => false,
    });
    way.lead_to(&nats_uri(&cluster));
    copy.flush().unwrap();
    let stored = content(&shared(second.uri(), &space));
    assert_eq!(Vec::from_iter(stored.keys().copied()), ids);
    wait_for_all(&copy, &[-1.0, 0.0], &[&copy]);
    let stored = content(&shared(second.uri(), &space));
    check_copies(&stored, &space, &[&copy]);
}

#[test]
#[ignore = "needs nats-server"]
fn a_copy_does_not_go_back_to_the_index_that_was_before_its_own() {
    makes_unheard(true);
}

#[test]
#[ignore = "needs nats-server"]
fn a_copy_does_not_end_at_a_server_that_has_not_heard_of_its_index() {
    makes_unheard(false);
}

/// NATS may have lost it, or none of the deleted indices that are remembered has it.
#[tokio::test]
#[ignore = "needs nats-server"]
async fn a_uid_that_nothing_knows_is_past() {
    let cluster = Cluster::empty();
    let server = cluster.start(0);
    let client = Client::connect(server.uri()).await.unwrap();
    let index = client.create_index("arm", &"R2".parse().unwrap()).await;
    let index = index.unwrap();
    let lost = Revision::new("00000000-0000-4000-8000-000000000000", 1);
    let mut watch = loop {
        match index.watch().after(lost.clone()).await {
            Ok(watch) => break watch,
            // NATS is asked for a while.
            Err(error) => assert_eq!(error.reason(), Some("UID_UNKNOWN"), "{error}"),
        }
    };
    let Some(WatchEvent::Reset(reset)) = watch.next().await.unwrap() else {
        panic!("a feed of an index that is gone");
    };
    assert_eq!(reset.reason, ResetReason::UidChanged);

    // A name that no index may have is not asked for.
    let mut stubs = Stubs::connect(server.uri()).await;
    let read = GetRequest {
        index_name: "a".repeat(64),
        min_revision: Some(wayfold_proto::v1::Revision {
            uid: reset.revision.uid.to_string(),
            number: 1,
        }),
        ..Default::default()
    };
    let refused = stubs.points.get(read).await.unwrap_err();
    assert_eq!(refused.code(), tonic::Code::NotFound, "{refused}");
}

/// Its connections stay open, and nothing comes.
#[tokio::test]
async fn a_server_that_stands_still_is_left() {
    let [first, second] = [(); 2].map(|()| server!());
    let uris = format!("{},{}", first.uri(), second.uri());
    let client = Client::connect(&uris).await.unwrap();
    client.server().await.unwrap();
    first.process().signal(Signal::Pause);
    client.server().await.unwrap();
    first.process().signal(Signal::Resume);
    second.stop(Signal::Kill);
    client.server().await.unwrap();
}

#[test]
#[ignore = "needs nats-server"]
fn a_copy_leaves_a_server_that_is_cut_off_from_the_journal() {
    let servers = TwoServers::start();
    let (cut_off, uri) = (servers.second.uri(), servers.first.uri());
    let space: Space = "R2".parse().unwrap();
    let index = shared(&format!("{cut_off},{uri}"), &space);
    wait_for_index(uri);
    let other = shared(uri, &space);
    insert(&index, 0);
    wait_for_all(&index, &[-1.0, 0.0], &[&other]);

    servers.way.close();
    insert(&index, POINTS);
    index.flush().unwrap();
    let late = other.insert([-2.0, 0.0]).unwrap();
    while index.get(late).unwrap().is_none() {
        thread::yield_now();
    }
    wait_for_all(&index, &[-3.0, 0.0], &[&other, &index]);
    let stored = content(&shared(uri, &space));
    assert_eq!(stored.len(), 2 * POINTS + 3);
    check_copies(&stored, &space, &[&index, &other]);
}
