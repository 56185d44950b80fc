//! Two servers of a cluster under one prefix: a query reaches one of them, and the owner of an index publishes its mutations.
//! The environment variable `NATS_SERVER` has the path of the program nats-server.

use serde_json::{Value, json};
use wayfold_tests::{Signal, Stubs, nats::Nats};
use zenoh::bytes::Encoding;

use crate::{
    feed::{next, subscribe},
    robot::{Robot, reason, server_with, session},
};

const MUTATIONS: u64 = 40;

/// One reply to each, or the assertion in [`Robot::ask`] fails.
async fn insert(robot: &Robot, number: u64) -> Result<Value, Value> {
    let body = json!({ "states": [[number as f64]], "operation_id": format!("insert {number}") });
    robot.json("arm/insert", body).await
}

#[ignore = "needs nats-server"]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn several_servers_answer_as_one() {
    let directory = tempfile::tempdir().unwrap();
    let nats = Nats::start(directory.path(), 1);
    let settings = nats.member_settings();
    let settings = settings.each_ref().map(|it| (it.0, &*it.1));
    let mut servers = [(); 2].map(|()| server_with(&[], &settings));
    for (server, _) in &mut servers {
        server.log_until("a server joins the cluster");
    }
    let locators: Vec<&str> = servers.iter().map(|(_, locator)| &**locator).collect();
    let robot = Robot {
        session: session("peer", &[], &locators).await,
    };
    let space = json!({ "name": "arm", "space_text": "R1" });
    let created = robot.json("create", space).await.unwrap();
    for (server, _) in &servers {
        Stubs::connect(server.uri()).await.find("arm").await;
    }

    let refused = robot.json("delete", json!({ "index_name": "arm" })).await;
    assert_eq!(reason(&refused.unwrap_err()), (3, "REQUIRED"));
    let refused = robot.json("arm/insert", json!({ "states": [[0.0]] })).await;
    assert_eq!(reason(&refused.unwrap_err()), (3, "REQUIRED"));

    let events = subscribe(&robot).await;
    let mut inserted = 0;
    while events.is_empty() {
        insert(&robot, inserted).await.unwrap();
        inserted += 1;
    }
    for _ in 0..MUTATIONS {
        insert(&robot, inserted).await.unwrap();
        // A repetition has the first answer, whichever server it reaches.
        insert(&robot, inserted).await.unwrap();
        inserted += 1;
    }
    let mut revisions = Vec::new();
    while revisions.last().is_none_or(|last| *last < inserted) {
        let event = next(&events).await;
        let numbers = event.mutations.iter().filter_map(|it| it.revision.as_ref());
        revisions.extend(numbers.map(|revision| revision.number));
    }
    let first = revisions[0];
    assert_eq!(revisions, (first..=inserted).collect::<Vec<u64>>());
    for (server, _) in &servers {
        let mut stubs = Stubs::connect(server.uri()).await;
        stubs.latest("arm").await.unwrap();
        assert_eq!(stubs.describe("arm").await.point_count, inserted);
    }

    let uid = &created["index"]["revision"]["uid"];
    let deletion = json!({ "index_name": "arm", "uid": uid });
    let deleted = robot.json("delete", deletion).await.unwrap();
    assert_eq!(deleted["uid"], *uid);
}

#[ignore = "needs nats-server"]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_query_that_is_forwarded_stays_in_its_trace() {
    const TRACE: &str = "4bf92f3577b34da6a3ce929d0e0e4736";
    let directory = tempfile::tempdir().unwrap();
    let nats = Nats::start(directory.path(), 1);
    let settings = nats.member_settings();
    let settings = settings.each_ref().map(|it| (it.0, &*it.1));
    let debug = ["--log", "wayfold_server=debug"];
    let mut servers = [(); 2].map(|()| server_with(&debug, &settings));
    for (server, _) in &mut servers {
        server.log_until("a server joins the cluster");
    }
    Stubs::connect(servers[0].0.uri())
        .await
        .create("arm", "R1")
        .await;
    for (server, locator) in &servers {
        Stubs::connect(server.uri()).await.find("arm").await;
        let robot = Robot::connect(locator).await;
        let body = json!({ "states": [[0.5]], "operation_id": locator });
        let answers = robot.session.get("wayfold/v1/arm/insert");
        let answers = answers.payload(body.to_string());
        let answers = answers.encoding(Encoding::APPLICATION_JSON);
        let answers = answers.attachment(format!("traceparent=00-{TRACE}-00f067aa0ba902b7-01"));
        let answer = answers.await.unwrap().recv_async().await.unwrap();
        answer.into_result().unwrap();
    }
    let logs = servers.map(|(server, _)| server.stop(Signal::Terminate).stderr);
    let logs = logs.concat();
    // One of the two queries reached the owner, which got the other by gRPC.
    let calls = ["Zenoh/insert", "PointService/Insert"].map(|rpc| {
        let calls = logs
            .lines()
            .filter(|it| it.contains(rpc) && it.contains("call ended"));
        calls.filter(|it| it.contains(TRACE)).count()
    });
    assert_eq!(calls, [2, 1], "{logs}");
}
