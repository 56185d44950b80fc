//! A server that cannot follow the journal takes a copy of another server, unless the two contradict each other. The
//! environment variable `NATS_SERVER` has the path of the program nats-server.

use std::time::Duration;

use tokio::time::{Instant, interval, timeout};
use tonic::Code;
use tonic_health::pb::health_check_response::ServingStatus;
use wayfold_proto::v1::{InsertRequest, ListIndexesRequest};
use wayfold_tests::{Content, ServerProcess, Signal, Stubs, row_states};

use crate::{
    health::health,
    journal_loss::{Cluster, MAX_WAIT, insert, insert_until_acknowledged},
    metrics::figures,
};

pub(crate) const JOINS: &str = "a server joins the cluster";
pub(crate) const HEALED: &str = "goes on from a copy of another server";

/// Starts servers that hear each other.
pub(crate) fn together<const N: usize>(
    cluster: &Cluster,
    settings: &[(&str, &str)],
) -> [ServerProcess; N] {
    let mut servers = std::array::from_fn(|number| cluster.start_with(number, settings));
    wait_until_joined(&mut servers);
    servers
}

/// Waits until each of these servers hears all others.
pub(crate) fn wait_until_joined(servers: &mut [ServerProcess]) {
    for _ in 1..servers.len() {
        for server in &mut *servers {
            server.log_until(JOINS);
        }
    }
}

/// An insert that takes effect once.
fn with_payload(id: u64) -> InsertRequest {
    InsertRequest {
        index_name: "arm".into(),
        states: Some(row_states(&[id as f64], 1)),
        ids: vec![id],
        payloads: vec![vec![id as u8; 100].into()],
        operation_id: format!("insert {id}"),
        ..Default::default()
    }
}

/// The content of a server once it has all that was acknowledged.
pub(crate) async fn latest_content(stubs: &mut Stubs) -> Content {
    let caught_up = async { while stubs.latest("arm").await.is_err() {} };
    timeout(MAX_WAIT, caught_up).await.unwrap();
    Content::read(stubs, "arm").await.unwrap()
}

#[ignore = "needs nats-server"]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_server_before_a_gap_of_the_journal_takes_a_copy() {
    const POINTS: u64 = 40;
    let cluster = Cluster::empty();
    let servers: [_; 2] = together(&cluster, &[]);
    let mut first = Stubs::connect(servers[0].uri()).await;
    let mut second = Stubs::connect(servers[1].uri()).await;
    let created = first.create("arm", "R1").await;
    let uid = created.revision.unwrap().uid;
    second.find("arm").await;
    for id in 0..POINTS {
        first.insert(with_payload(id)).await;
    }
    let expected = latest_content(&mut first).await.points;
    assert_eq!(latest_content(&mut second).await.points, expected);

    let removed = cluster.nats.remove_record(&uid, POINTS / 2).await;
    assert!(removed, "the message of one record");
    let mut third = cluster.start(2);
    third.log_until(HEALED);
    let mut stubs = Stubs::connect(third.uri()).await;
    assert_eq!(latest_content(&mut stubs).await.points, expected);

    // It goes on without the others, and remembers the calls that were made before the copy.
    for server in servers {
        server.stop(Signal::Kill);
    }
    for id in POINTS - 1..=POINTS {
        let written = async { while stubs.points.insert(with_payload(id)).await.is_err() {} };
        timeout(MAX_WAIT, written).await.unwrap();
    }
    let content = latest_content(&mut stubs).await;
    assert!(content.points.keys().copied().eq(0..=POINTS));
    // It has the payloads, and the repeated call did not replace a point.
    let kept = content.points.iter().filter(|(id, _)| **id < POINTS);
    assert!(kept.eq(expected.iter()));

    // The copy is in its directory.
    third.stop(Signal::Kill);
    let third = cluster.start(2);
    let mut stubs = Stubs::connect(third.uri()).await;
    assert_eq!(latest_content(&mut stubs).await.points, content.points);
}

const KEPT: u64 = 5;
const LOST: u64 = 10;

#[ignore = "needs nats-server"]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_server_that_another_one_contradicts_stays_stopped() {
    contradict(2 * LOST, 1).await;
}

/// The journal ends at the revision that the server has applied, with another record.
#[ignore = "needs nats-server"]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_server_compares_its_newest_record_when_it_starts() {
    contradict(0, 1).await;
}

#[ignore = "needs nats-server"]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_operator_chooses_the_records_that_nats_has_lost() {
    contradict(2 * LOST, 0).await;
}

/// A cluster whose NATS has lost records that server 0, with these settings, had applied before it was stopped: its content
/// then, and server 1, which has the older records alone.
async fn set_back(settings: &[(&str, &str)]) -> (Cluster, Content, ServerProcess, Stubs) {
    let mut cluster = Cluster::empty();
    let server = cluster.start_with(0, settings);
    let mut stubs = Stubs::connect(server.uri()).await;
    stubs.create("arm", "R1").await;
    for id in 0..KEPT {
        insert(&mut stubs, id).await.unwrap();
    }
    cluster.save_store();
    insert_until_acknowledged(&mut stubs, KEPT..KEPT + LOST).await;
    let expected = latest_content(&mut stubs).await;
    // Killed, it might not have stored the newest records.
    server.stop(Signal::Terminate);
    cluster.set_store_back();
    let other = cluster.start(1);
    let mut others = Stubs::connect(other.uri()).await;
    others.find("arm").await;
    (cluster, expected, other, others)
}

/// NATS loses records that one server has applied, and the other one writes others in their place, and this many more. Then
/// the operator chooses a server.
async fn contradict(more: u64, chosen: usize) {
    let (cluster, expected, other, mut others) = set_back(&[]).await;
    let mut written = 1000;
    let head = async |stubs: &mut Stubs| stubs.describe("arm").await.revision.unwrap().number;
    while head(&mut others).await < expected.revision + more {
        insert(&mut others, written).await.unwrap();
        written += 1;
    }

    let mut server = cluster.start(0);
    server.log_until("two servers contradict each other");
    let mut stubs = Stubs::connect(server.uri()).await;
    assert_eq!(Content::read(&stubs, "arm").await.unwrap(), expected);
    let listed = stubs.indexes.list_indexes(ListIndexesRequest::default());
    let listed = listed.await.unwrap().into_inner();
    let [damaged] = &listed.damaged[..] else {
        panic!("{listed:?}");
    };
    let text = format!("{damaged:?}");
    assert!(text.contains("has applied another record"), "{text}");

    // Writing stops at both, and reads go on.
    refuse(&mut others, 2000).await;
    let found = Content::read(&others, "arm").await.unwrap();
    assert!(found.points.contains_key(&1000));
    other.stop(Signal::Kill);
    refuse(&mut stubs, 3000).await;
    assert_eq!(Content::read(&stubs, "arm").await.unwrap(), expected);
    let log = server.stop(Signal::Kill).stderr;
    assert!(!log.contains(HEALED), "{log}");

    // The other server refuses writes too, also alone: no operator has chosen.
    let other = cluster.start(1);
    let mut others = Stubs::connect(other.uri()).await;
    refuse(&mut others, 4000).await;
    other.stop(Signal::Kill);
    let kept = [expected.points, found.points];
    cluster.reseed(chosen);
    let mut servers = Vec::new();
    for number in [chosen, 1 - chosen] {
        let server = cluster.start(number);
        let mut stubs = Stubs::connect(server.uri()).await;
        assert_eq!(latest_content(&mut stubs).await.points, kept[chosen]);
        servers.push((server, stubs));
    }
    let [(_, first), (_, second)] = &mut servers[..] else {
        unreachable!("two servers");
    };
    let written = insert_until_acknowledged(second, 5000..5001);
    timeout(MAX_WAIT, written).await.unwrap();
    let written = latest_content(first).await;
    assert!(written.points.contains_key(&5000) && written.uid != expected.uid);
}

/// Inserts points from this id on until the server refuses one: it may not have heard of the other one yet.
async fn refuse(stubs: &mut Stubs, first: u64) {
    let refused = async {
        for id in first.. {
            // A call may still be on its way to the other server.
            if let Err(refused) = insert(stubs, id).await
                && refused.code() == Code::DataLoss
            {
                assert!(refused.message().contains("another record"), "{refused}");
                return;
            }
        }
    };
    timeout(MAX_WAIT, refused).await.unwrap();
}

/// It would own some of the indices, and could evaluate no mutation of them.
#[ignore = "needs nats-server"]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_server_without_its_store_is_not_live_for_the_others() {
    const INDICES: u64 = 8;
    let cluster = Cluster::empty();
    let [first, mut second] = together(&cluster, &[]);
    let pages = second.pages();
    let mut stubs = Stubs::connect(second.uri()).await;
    for number in 0..INDICES {
        stubs.create(&format!("arm-{number}"), "R1").await;
    }
    first.stop(Signal::Terminate);
    cluster.lose_points(0);
    let first = cluster.start(0);
    let insert = |number: u64, id: u64| InsertRequest {
        index_name: format!("arm-{number}"),
        states: Some(row_states(&[id as f64], 1)),
        ids: vec![id],
        ..Default::default()
    };
    // A live server announces itself each half second.
    let until = Instant::now() + Duration::from_secs(3);
    let mut inserted = 0;
    while Instant::now() < until {
        for number in 0..INDICES {
            stubs.insert(insert(number, inserted)).await;
        }
        inserted += 1;
    }
    let figures = figures(&pages);
    for number in 0..INDICES {
        let owned = format!("wayfold_index_owned{{index=\"arm-{number}\"}}");
        assert_eq!(figures[owned.as_str()], 1.0, "the first owns {number}");
    }
    let mut stubs = Stubs::connect(first.uri()).await;
    let refused = stubs.points.insert(insert(0, inserted)).await;
    let refused = refused.unwrap_err();
    assert_eq!(refused.code(), Code::Unavailable);
    let text = refused.message();
    assert!(text.contains("call another server"), "{text}");
}

/// NATS loses records that one server has applied, the other one writes another record in their place, and the journal still
/// ends before what the first has applied. So no copy of the other one is new enough.
#[ignore = "needs nats-server"]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_server_ahead_of_another_history_stays_stopped() {
    let (cluster, expected, _other, mut others) = set_back(&[]).await;
    insert(&mut others, 1000).await.unwrap();

    let mut server = cluster.start(0);
    let log = server.log_until("two servers contradict each other");
    let line = log.last().unwrap();
    for part in ["ERROR", "another record of revision 6", "reseed"] {
        assert!(line.contains(part), "{line}");
    }
    let mut stubs = Stubs::connect(server.uri()).await;
    let until = Instant::now() + Duration::from_secs(5);
    let mut looks = interval(Duration::from_millis(20));
    while Instant::now() < until {
        let listed = stubs.indexes.list_indexes(ListIndexesRequest::default());
        let listed = listed.await.unwrap().into_inner();
        let [damaged] = &listed.damaged[..] else {
            panic!("{listed:?}");
        };
        let text = format!("{damaged:?}");
        assert!(text.contains("has applied another record"), "{text}");
        looks.tick().await;
    }
    let indices = figures(&server.pages());
    assert_eq!(indices["wayfold_indices{state=\"damaged\"}"], 1.0);
    let status = async |name| health(server.uri(), name).await;
    assert_eq!(status("wayfold.indices").await, ServingStatus::NotServing);
    assert_eq!(status("wayfold.reading").await, ServingStatus::Serving);
    refuse(&mut stubs, 3000).await;
    // The other one compares the two before it writes.
    refuse(&mut others, 2000).await;
    assert_eq!(Content::read(&stubs, "arm").await.unwrap(), expected);
}

#[ignore = "needs nats-server"]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_operator_hears_what_a_new_generation_leaves_out() {
    let cluster = Cluster::empty();
    let [server, behind]: [_; 2] = together(&cluster, &[]);
    let mut stubs = Stubs::connect(server.uri()).await;
    stubs.create("arm", "R1").await;
    stubs.insert(with_payload(0)).await;
    let mut others = Stubs::connect(behind.uri()).await;
    others.find("arm").await;
    latest_content(&mut others).await;
    behind.stop(Signal::Terminate);
    for id in 1..6 {
        stubs.insert(with_payload(id)).await;
    }
    server.stop(Signal::Terminate);
    let told = cluster.reseed(1);
    assert!(told.contains("left out: 5 later revisions"), "{told}");
    let server = cluster.start(1);
    let content = latest_content(&mut Stubs::connect(server.uri()).await).await;
    server.stop(Signal::Terminate);
    cluster.nats.damage(&content.uid).await;
    let told = cluster.reseed(1);
    assert!(told.contains("it cannot be read"), "{told}");
    let server = cluster.start(1);
    latest_content(&mut Stubs::connect(server.uri()).await).await;
    server.stop(Signal::Terminate);
    let told = cluster.reseed(1);
    assert!(!told.contains("left out"), "{told}");
}

/// The server has the points of the records that NATS has lost, and the records are outside of its window.
#[ignore = "needs nats-server"]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_operator_keeps_the_points_of_records_that_no_server_has() {
    const WINDOW: [(&str, &str); 1] = [("WAYFOLD_INDEX__WINDOW_BYTES", "1")];
    let (cluster, expected, mut other, mut others) = set_back(&WINDOW).await;
    let server = cluster.start_with(0, &WINDOW);
    other.log_until(JOINS);
    let refused = insert(&mut others, 1000).await.unwrap_err();
    assert_eq!(refused.code(), Code::Unavailable, "{refused}");
    let applied = format!(
        "has applied the records up to revision {}",
        expected.revision
    );
    assert!(refused.message().contains(&applied), "{refused}");
    let mut stubs = Stubs::connect(server.uri()).await;
    insert(&mut stubs, 1000).await.unwrap_err();
    assert_eq!(Content::read(&stubs, "arm").await.unwrap(), expected);

    server.stop(Signal::Terminate);
    cluster.reseed(0);
    let server = cluster.start_with(0, &WINDOW);
    let mut stubs = Stubs::connect(server.uri()).await;
    assert_eq!(latest_content(&mut stubs).await.points, expected.points);
    let copied = async {
        loop {
            let content = Content::read(&others, "arm").await;
            if let Some(content) = content.ok().filter(|it| it.uid != expected.uid) {
                return content.points;
            }
        }
    };
    assert_eq!(timeout(MAX_WAIT, copied).await.unwrap(), expected.points);
    let written = insert_until_acknowledged(&mut others, 1000..1001);
    timeout(MAX_WAIT, written).await.unwrap();
    let written = latest_content(&mut stubs).await.points;
    assert_eq!(written.len(), expected.points.len() + 1);
}
