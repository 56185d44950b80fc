//! The publications: the mutations of an index, whole and in order, and the list of indices.

#[cfg(target_os = "linux")]
mod slow;

use prost::Message;
use serde_json::{Value, json};
use wayfold_proto::v1::{self, ResetReason};
use wayfold_tests::{Content, INCLUDE_ALL, Stubs, number, revision, row_states};
use zenoh::{
    handlers::FifoChannelHandler,
    pubsub::Subscriber,
    sample::{Sample, SampleKind},
};

use crate::{
    follower::Follower,
    robot::{Robot, server},
};

pub(crate) type Events = Subscriber<FifoChannelHandler<Sample>>;

pub(crate) async fn subscribe(robot: &Robot) -> Events {
    subscribe_to(robot, "events").await
}

async fn subscribe_to(robot: &Robot, last: &str) -> Events {
    let key = format!("wayfold/v1/arm/{last}");
    robot.session.declare_subscriber(key).await.unwrap()
}

pub(crate) async fn next(events: &Events) -> v1::WatchResponse {
    let sample = events.recv_async().await.unwrap();
    assert_eq!(sample.encoding().to_string(), "application/protobuf");
    v1::WatchResponse::decode(&*sample.payload().to_bytes()).unwrap()
}

/// The uid of an index that was just created.
pub(crate) fn uid(index: v1::Index) -> String {
    index.revision.unwrap().uid
}

pub(crate) fn insertion(ids: &[u64], payload: usize) -> v1::InsertRequest {
    let rows: Vec<f64> = ids.iter().flat_map(|id| [*id as f64, 0.5]).collect();
    v1::InsertRequest {
        index_name: "arm".into(),
        states: Some(row_states(&rows, 2)),
        ids: ids.into(),
        tags: ids.iter().map(|id| id % 3).collect(),
        payloads: vec![vec![7; payload].into(); ids.len()],
        on_conflict: v1::OnConflict::Replace.into(),
        ..Default::default()
    }
}

/// Makes `count` mutations, from `first` on: inserts, updates and removals.
async fn mutate(stubs: &mut Stubs, first: u64, count: u64) {
    for step in first..first + count {
        match step % 4 {
            0 | 1 => drop(
                stubs
                    .insert(insertion(&[step, step / 2 + 1_000], step as usize % 50))
                    .await,
            ),
            2 => {
                let update = v1::UpdateRequest {
                    index_name: "arm".into(),
                    ids: vec![step - 1],
                    tags: vec![step],
                    ..Default::default()
                };
                stubs.points.update(update).await.unwrap();
            }
            _ => {
                let removal = v1::RemoveRequest {
                    index_name: "arm".into(),
                    ids: vec![step - 3],
                    ..Default::default()
                };
                stubs.points.remove(removal).await.unwrap();
            }
        }
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn events_are_what_a_watch_tells() {
    let (server, locator) = server();
    let mut stubs = Stubs::connect(server.uri()).await;
    let uid = uid(stubs.create("arm", "R2").await);
    let robot = Robot::connect(&locator).await;
    let events = subscribe(&robot).await;
    let mut follower = Follower::new(&robot, &uid);
    // The first publication to a follower names the newest revision of the index.
    follower.take(next(&events).await).await;
    let watched = v1::WatchRequest {
        index_name: "arm".into(),
        after_revision: revision(&uid, 0),
        include: Some(INCLUDE_ALL),
        own_session: 0,
    };
    let mut watch = stubs.points.watch(watched).await.unwrap().into_inner();

    mutate(&mut stubs, 0, 200).await;
    // Larger than a message of the feed.
    stubs
        .insert(insertion(&(5_000..5_020).collect::<Vec<_>>(), 40_000))
        .await;
    catch_up(&mut follower, &events, &mut stubs).await;
    assert_eq!(
        follower.content,
        Content::read(&stubs, "arm").await.unwrap()
    );
    let mut received: Vec<v1::Mutation> = Vec::new();
    while received.last().map(|last| number(&last.revision)) < Some(follower.content.revision) {
        received.extend(watch.message().await.unwrap().unwrap().mutations);
    }
    assert_eq!(whole(received), whole(follower.mutations));
}

/// Takes publications until the follower has the newest revision. Any publication may be dropped, and only the next one
/// shows it, so the test always makes one more.
pub(crate) async fn catch_up(follower: &mut Follower<'_>, events: &Events, stubs: &mut Stubs) {
    loop {
        let made = stubs.insert(insertion(&[9_999], 1)).await;
        let made = number(&made.revision);
        while let Ok(Some(sample)) = events.try_recv() {
            let received = v1::WatchResponse::decode(&*sample.payload().to_bytes()).unwrap();
            follower.take(received).await;
        }
        let removed = v1::RemoveRequest {
            index_name: "arm".into(),
            ids: vec![9_999],
            ..Default::default()
        };
        stubs.points.remove(removed).await.unwrap();
        if follower.content.revision >= made {
            follower.repair(made + 1).await;
            return;
        }
    }
}

/// Joins the pieces of each mutation.
fn whole(pieces: Vec<v1::Mutation>) -> Vec<v1::Mutation> {
    let mut whole: Vec<v1::Mutation> = Vec::new();
    for piece in pieces {
        match whole.last_mut().filter(|last| last.continued) {
            Some(last) => {
                // Merging the encoded pieces appends to repeated fields.
                let continued = piece.continued;
                let mut bytes = last.encode_to_vec();
                let more = piece.stored.clone().unwrap_or_default();
                let states = last.stored.as_mut().and_then(|it| it.states.as_mut());
                let rows =
                    states.map_or(0, |it| it.row_count) + more.states.map_or(0, |it| it.row_count);
                bytes.extend(piece.encode_to_vec());
                *last = v1::Mutation::decode(&*bytes).unwrap();
                (last.continued, last.piece) = (continued, 0);
                if let Some(states) = last.stored.as_mut().and_then(|it| it.states.as_mut()) {
                    states.row_count = rows;
                }
            }
            None => whole.push(piece),
        }
    }
    whole
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn events_without_payloads_are_otherwise_the_same() {
    let (server, locator) = server();
    let mut stubs = Stubs::connect(server.uri()).await;
    stubs.create("arm", "R2").await;
    let robot = Robot::connect(&locator).await;
    let whole = subscribe(&robot).await;
    let states = subscribe_to(&robot, "events/states").await;
    // The first publication has no mutation: both are followed from here on.
    for events in [&whole, &states] {
        assert!(next(events).await.mutations.is_empty());
    }
    let mut payloads = 0;
    for round in 0..40 {
        // The mutations are made one at a time, so that the link has room for each.
        mutate(&mut stubs, round, 1).await;
        let mut expected = next(&whole).await.mutations;
        for stored in expected.iter_mut().flat_map(|it| &mut it.stored) {
            payloads += std::mem::take(&mut stored.payloads).len();
        }
        assert_eq!(next(&states).await.mutations, expected);
    }
    assert!(payloads > 0);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_gap_is_seen_and_repaired_from_the_log() {
    let (server, locator) = server();
    let mut stubs = Stubs::connect(server.uri()).await;
    let uid = uid(stubs.create("arm", "R2").await);
    // These mutations precede the first follower.
    mutate(&mut stubs, 0, 20).await;
    let robot = Robot::connect(&locator).await;
    let events = subscribe(&robot).await;
    let mut follower = Follower::new(&robot, &uid);
    follower.take(next(&events).await).await;
    assert_eq!((follower.content.revision, follower.repairs), (20, 1));
    for round in 0..20 {
        // The mutations are made one at a time, so that each has its own publication; every third is lost.
        mutate(&mut stubs, 20 + round, 1).await;
        let received = next(&events).await;
        if round % 3 > 0 {
            follower.take(received).await;
        }
    }
    // The loss of the last publication shows only once another arrives.
    mutate(&mut stubs, 40, 1).await;
    follower.take(next(&events).await).await;
    assert_eq!(
        follower.content,
        Content::read(&stubs, "arm").await.unwrap()
    );
    assert!(follower.repairs >= 7, "{}", follower.repairs);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_piece_that_is_missing_is_seen() {
    let (server, locator) = server();
    let mut stubs = Stubs::connect(server.uri()).await;
    let uid = uid(stubs.create("arm", "R2").await);
    let robot = Robot::connect(&locator).await;
    let events = subscribe(&robot).await;
    let mut follower = Follower::new(&robot, &uid);
    follower.take(next(&events).await).await;
    // Each of the three pieces is lost once, and the next piece still belongs to the same mutation.
    for lost in 0..3 {
        let ids: Vec<_> = (lost * 100..lost * 100 + 60).collect();
        let made = stubs.insert(insertion(&ids, 5_000)).await;
        let made = number(&made.revision);
        let mut publications = 0;
        loop {
            let received = next(&events).await;
            let is_last = received
                .mutations
                .iter()
                .any(|received| !received.continued);
            if publications != lost {
                follower.take(received).await;
            }
            publications += 1;
            if is_last {
                break;
            }
        }
        assert!(publications > 3);
        follower.repair(made).await;
        assert_eq!(
            follower.content,
            Content::read(&stubs, "arm").await.unwrap()
        );
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn events_come_in_json_too() {
    let (_server, locator) = server();
    let robot = Robot::connect(&locator).await;
    let create = json!({ "name": "arm", "space_text": "R2" });
    let created = robot.json("create", create).await.unwrap();
    let uid = created["index"]["revision"]["uid"].clone();
    let revision = |number: u64| json!({ "uid": uid, "number": number });
    let events = robot.session.declare_subscriber("wayfold/v1/*/events/json");
    let events = events.await.unwrap();
    let next = async || -> Value {
        let sample = events.recv_async().await.unwrap();
        assert_eq!(sample.key_expr().as_str(), "wayfold/v1/arm/events/json");
        assert_eq!(sample.encoding().to_string(), "application/json");
        serde_json::from_slice(&sample.payload().to_bytes()).unwrap()
    };
    assert_eq!(
        next().await,
        json!({ "revision": revision(0), "mutations": [] })
    );
    let insert = json!({ "states": [[1, 2]], "ids": [7], "tags": [3] });
    robot.json("arm/insert", insert).await.unwrap();
    let mut received = next().await;
    let time_ms = received["mutations"][0]["time_ms"].take();
    assert!(time_ms.as_u64().unwrap() > 0);
    let stored = json!({
        "ids": [7], "states": [[1.0, 2.0]], "tags": [3], "revisions": [1], "payloads": [""]
    });
    let mutation = json!({
        "revision": revision(1), "time_ms": null, "stored": stored, "removed_ids": [], "continued": false, "piece": 0,
        "session": 0, "batch": 0
    });
    assert_eq!(
        received,
        json!({ "revision": revision(1), "mutations": [mutation] })
    );
    let selector = format!("arm/log?from=0;uid={}", uid.as_str().unwrap());
    let received = robot.json(&selector, Value::Null).await.unwrap();
    assert_eq!(received["mutations"][0]["removed_ids"], json!([]));

    let opened = robot.json("arm/session", json!({ "uid": uid })).await;
    assert_eq!(opened.unwrap()["session"], 2);
    let steps = json!({
        "uid": uid, "session": 2, "batch": 1, "kinds": ["REMOVE"], "ids": [7], "reserve_count": 1
    });
    robot.json("arm/write", steps).await.unwrap();
    for (revision, session, batch, removed) in [(2, 0, 0, json!([])), (3, 2, 1, json!([7]))] {
        let mutation = next().await["mutations"][0].take();
        assert_eq!(mutation["revision"]["number"], revision);
        let made_by = (&mutation["session"], &mutation["batch"]);
        assert_eq!(made_by, (&json!(session), &json!(batch)));
        assert_eq!(mutation["removed_ids"], removed);
    }
    let selector = format!("{};own_session=2", selector.replace("from=0", "from=2"));
    let own = robot.json(&selector, Value::Null).await.unwrap()["mutations"][0].take();
    assert_eq!((&own["session"], &own["batch"]), (&json!(2), &json!(1)));
    assert_eq!(own["removed_ids"], json!([]));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn tokens_tell_which_indices_are_served_and_uids_that_one_is_another() {
    let (server, locator) = server();
    let mut stubs = Stubs::connect(server.uri()).await;
    let old = uid(stubs.create("arm", "R2").await);
    let robot = Robot::connect(&locator).await;
    let liveliness = robot.session.liveliness();
    let alive = liveliness
        .declare_subscriber("wayfold/v1/*/@alive")
        .history(true);
    let alive = alive.await.unwrap();
    let next_token = async || {
        let sample = alive.recv_async().await.unwrap();
        (sample.kind(), sample.key_expr().to_string())
    };
    let token = |name: &str| format!("wayfold/v1/{name}/@alive");
    assert_eq!(next_token().await, (SampleKind::Put, token("arm")));
    stubs.create("leg", "R2").await;
    assert_eq!(next_token().await, (SampleKind::Put, token("leg")));
    stubs.delete("leg").await;
    assert_eq!(next_token().await, (SampleKind::Delete, token("leg")));

    let events = subscribe(&robot).await;
    let mut follower = Follower::new(&robot, &old);
    follower.take(next(&events).await).await;
    mutate(&mut stubs, 0, 2).await;
    while follower.content.revision < 2 {
        follower.take(next(&events).await).await;
    }
    stubs.delete("arm").await;
    let new = uid(stubs.create("arm", "R2").await);
    mutate(&mut stubs, 0, 3).await;
    assert_eq!(next_token().await, (SampleKind::Delete, token("arm")));
    assert_eq!(next_token().await, (SampleKind::Put, token("arm")));
    // The follower knows another history; both the publication and the log report it.
    let received = next(&events).await;
    assert_eq!(received.revision.as_ref().unwrap().uid, new);
    let reset = follower.log().await;
    assert_eq!(reset.reset(), ResetReason::UidChanged);
    assert_eq!(reset.revision.unwrap().uid, new);
    let mut follower = Follower::new(&robot, &new);
    follower.take(received).await;
    follower.repair(3).await;
    assert_eq!(
        follower.content,
        Content::read(&stubs, "arm").await.unwrap()
    );
}
