//! An index is restored in a cluster: its points are in no journal, so a second server has a copy before the answer. The
//! environment variable `NATS_SERVER` has the path of the program nats-server.

use tokio::time::timeout;
use tokio_stream::iter;
use tonic::{Code, Status};
use wayfold_proto::v1::{InsertRequest, ListIndexesRequest, RestoreIndexRequest, SnapshotPart};
use wayfold_tests::{Content, ServerProcess, Signal, States, Stubs, row_states, server};

use crate::{
    healing::{latest_content, together},
    journal_loss::{Cluster, MAX_WAIT},
    restore::{lived_in, snapshot},
};

/// A snapshot of an index with a history, and its points.
async fn original() -> (Vec<SnapshotPart>, Content) {
    let source = server!();
    let mut stubs = Stubs::connect(source.uri()).await;
    lived_in(&mut stubs, "arm", 4).await;
    let content = Content::read(&stubs, "arm").await.unwrap();
    (snapshot(&mut stubs).await, content)
}

async fn restore(stubs: &mut Stubs, parts: &[SnapshotPart]) -> Result<String, Status> {
    let requests = parts.iter().map(|part| RestoreIndexRequest {
        name: "arm".into(),
        part: Some(part.clone()),
    });
    let requests: Vec<_> = requests.collect();
    let restored = stubs.indexes.restore_index(iter(requests)).await?;
    let index = restored.into_inner().index.unwrap();
    Ok(index.revision.unwrap().uid)
}

/// Inserts a point, again until that is acknowledged; returns its id, which the server assigns.
async fn insert(stubs: &mut Stubs, operation: u64) -> u64 {
    let request = InsertRequest {
        index_name: "arm".into(),
        states: Some(row_states(
            &States::new("R3*SO3:0.15".parse().unwrap(), operation).rows(1),
            7,
        )),
        operation_id: format!("operation {operation}"),
        ..Default::default()
    };
    let inserted = async {
        loop {
            if let Ok(inserted) = stubs.points.insert(request.clone()).await {
                return inserted.into_inner().ids[0];
            }
        }
    };
    timeout(MAX_WAIT, inserted).await.unwrap()
}

#[ignore = "needs nats-server"]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_restored_index_survives_the_loss_of_the_server_that_restored_it() {
    let (parts, original) = original().await;
    let cluster = Cluster::empty();
    let [first, second] = together(&cluster, &[]);
    let mut stubs = Stubs::connect(first.uri()).await;
    let uid = restore(&mut stubs, &parts).await.unwrap();
    first.stop(Signal::Kill);
    cluster.lose(0);

    let mut others = Stubs::connect(second.uri()).await;
    let copied = latest_content(&mut others).await;
    // The points are too many to be printed.
    assert!(copied.points == original.points && copied.uid == uid);
    assert!(copied.revision > original.revision);
    let id = insert(&mut others, 1).await;
    assert!(original.points.keys().all(|known| *known < id));
    let taken = restore(&mut others, &parts).await.unwrap_err();
    assert_eq!(taken.code(), Code::AlreadyExists);

    // A server without a directory takes a copy too.
    let expected = latest_content(&mut others).await.points;
    let first = cluster.start(0);
    let mut stubs = Stubs::connect(first.uri()).await;
    assert!(latest_content(&mut stubs).await.points == expected);
    let ids = [insert(&mut stubs, 2).await, insert(&mut others, 3).await];
    let expected = latest_content(&mut stubs).await;
    assert!(ids.iter().all(|id| expected.points.contains_key(id)));
    assert!(latest_content(&mut others).await.points == expected.points);
}

#[ignore = "needs nats-server"]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_only_live_server_restores_an_index_alone() {
    let (parts, original) = original().await;
    let cluster = Cluster::empty();
    let mut first = cluster.start(0);
    let mut stubs = Stubs::connect(first.uri()).await;
    restore(&mut stubs, &parts).await.unwrap();
    first.log_until("a restored index is on this one alone");
    first.stop(Signal::Kill);
    // It has the index after a restart, and a server that joins takes a copy.
    let servers = [0, 1].map(|number| cluster.start(number));
    for server in &servers {
        let mut stubs = Stubs::connect(server.uri()).await;
        stubs.find("arm").await;
        assert!(latest_content(&mut stubs).await.points == original.points);
    }
}

/// NATS has nothing any more, and the servers have their directories.
#[ignore = "needs nats-server"]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_index_whose_journal_is_gone_is_seeded_from_a_directory() {
    let (parts, _) = original().await;
    let mut cluster = Cluster::empty();
    let [first, second] = together(&cluster, &[]);
    let mut stubs = Stubs::connect(first.uri()).await;
    restore(&mut stubs, &parts).await.unwrap();
    insert(&mut stubs, 1).await;
    second.stop(Signal::Kill);
    insert(&mut stubs, 2).await;
    let expected = latest_content(&mut stubs).await;
    first.stop(Signal::Kill);
    cluster.lose_store();

    cluster.reseed(0);
    let servers = [0, 1].map(|number| cluster.start(number));
    for server in &servers {
        let mut stubs = Stubs::connect(server.uri()).await;
        let content = latest_content(&mut stubs).await;
        assert!(content.points == expected.points && content.uid != expected.uid);
    }
    for (server, operation) in servers.iter().zip(3..) {
        insert(&mut Stubs::connect(server.uri()).await, operation).await;
    }
}

/// The journal of an index that was just restored has one message.
#[ignore = "needs nats-server"]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_restored_index_gets_its_only_message_back() {
    let (parts, original) = original().await;
    let cluster = Cluster::empty();
    let [mut first, second] = together(&cluster, &[]);
    let mut stubs = Stubs::connect(first.uri()).await;
    let uid = restore(&mut stubs, &parts).await.unwrap();
    second.stop(Signal::Kill);
    let (_, messages) = cluster.nats.messages(&uid).await;
    assert_eq!(messages.len(), 1);
    assert!(
        cluster
            .nats
            .remove_record(&uid, original.revision + 1)
            .await
    );

    // The server notices the loss when it writes.
    let id = insert(&mut stubs, 1).await;
    first.log_until("the journal had lost its newest records");
    let expected = latest_content(&mut stubs).await;
    assert!(expected.uid == uid && expected.points.contains_key(&id));
    let third = cluster.start(2);
    let mut others = Stubs::connect(third.uri()).await;
    assert!(latest_content(&mut others).await.points == expected.points);
}

const UNKNOWN: &str = "NATS does not know this index";

/// A server whose restore ended before NATS took the name: the journal has the origin record.
async fn unnamed(parts: &[SnapshotPart]) -> (Cluster, ServerProcess) {
    let mut cluster = Cluster::empty();
    let mut first = cluster.start(0);
    let mut stubs = Stubs::connect(first.uri()).await;
    stubs.create("leg", "R1").await;
    cluster.deny(&["$KV.>"]);
    reach_nats(&mut stubs).await;
    let refused = restore(&mut stubs, parts).await.unwrap_err();
    assert_eq!(refused.code(), Code::Unavailable, "{refused}");
    first.log_until("it is unknown whether an index was restored");
    (cluster, first)
}

/// Waits until a server is connected to NATS again.
async fn reach_nats(stubs: &mut Stubs) {
    let reached = async { while stubs.latest("leg").await.is_err() {} };
    timeout(MAX_WAIT, reached).await.unwrap();
}

#[ignore = "needs nats-server"]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_server_that_is_killed_before_a_restored_index_has_its_name_serves_none() {
    let (parts, original) = original().await;
    let (mut cluster, first) = unnamed(&parts).await;
    first.stop(Signal::Kill);
    cluster.deny(&[]);
    let mut first = cluster.start(0);
    first.log_until(UNKNOWN);
    let mut stubs = Stubs::connect(first.uri()).await;
    let listed = stubs.indexes.list_indexes(ListIndexesRequest::default());
    let listed = listed.await.unwrap().into_inner();
    assert!(listed.indexes.len() == 1 && listed.damaged.is_empty());
    restore(&mut stubs, &parts).await.unwrap();
    assert!(latest_content(&mut stubs).await.points == original.points);
}

#[ignore = "needs nats-server"]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_repeated_restore_removes_the_points_of_one_that_got_no_name() {
    let (parts, original) = original().await;
    let (mut cluster, first) = unnamed(&parts).await;
    cluster.deny(&[]);
    let mut stubs = Stubs::connect(first.uri()).await;
    reach_nats(&mut stubs).await;
    restore(&mut stubs, &parts).await.unwrap();
    first.stop(Signal::Terminate);
    let mut first = cluster.start(0);
    let mut log = first.log_until("replayed the log");
    let mut stubs = Stubs::connect(first.uri()).await;
    assert!(latest_content(&mut stubs).await.points == original.points);
    log.push(first.stop(Signal::Kill).stderr);
    assert!(!log.iter().any(|line| line.contains(UNKNOWN)), "{log:?}");
}
