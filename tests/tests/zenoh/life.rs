//! The Zenoh interface starts and stops with its server.

use std::env;

use serde_json::{Value, json};
use tokio::task::JoinSet;
use wayfold_tests::{Process, Signal};
use zenoh::{bytes::Encoding, query::ConsolidationMode};

use crate::robot::{MAX_WAIT, Robot, reason, router, server, server_with};

/// The number of times that a server is stopped, unless the environment variable `ZENOH_STOPS` sets another.
fn stops() -> usize {
    env::var("ZENOH_STOPS").map_or(3, |count| count.parse().unwrap())
}

/// The number of queries that keep the server busy.
const ACCEPTED: usize = 12;

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn accepted_queries_are_finished_and_later_ones_refused() {
    for stop in 0..stops() {
        println!("stop {stop}");
        stopped_under_load().await;
    }
}

async fn stopped_under_load() {
    let (mut server, locator) = server();
    let robot = Robot::connect(&locator).await;
    let space = json!({ "name": "arm", "space_text": "R3" });
    robot.json("create", space).await.unwrap();
    let rows: Vec<Value> = (0..1500)
        .map(|i| json!([i % 10, i / 10 % 10, f64::from(i) / 150.0]))
        .collect();
    let rows = json!({ "states": rows });
    robot.json("arm/insert", rows.clone()).await.unwrap();

    let mut accepted = JoinSet::new();
    let payload = rows.to_string();
    for _ in 0..ACCEPTED {
        let replies = robot
            .session
            .get("wayfold/v1/arm/knn?k=5")
            .payload(payload.clone())
            .consolidation(ConsolidationMode::None)
            .timeout(MAX_WAIT)
            .await
            .unwrap();
        accepted.spawn(async move {
            let mut results = Vec::new();
            while let Ok(reply) = replies.recv_async().await {
                results.push(reply.into_result());
            }
            results
        });
    }
    // The queries of a session arrive in order, so the answer to this one shows that the server has all of them.
    robot.json("arm/info", Value::Null).await.unwrap();

    server.process().signal(Signal::Terminate);
    server.log_until("stopping: finishing accepted calls");
    // A client that goes on querying must not cost another client its answer.
    let mut later = JoinSet::new();
    for _ in 0..200 {
        let replies = robot
            .session
            .get("wayfold/v1/arm/info")
            .consolidation(ConsolidationMode::None)
            .timeout(MAX_WAIT)
            .await;
        // A session that has lost its only link has no peer to ask.
        let Ok(replies) = replies else { break };
        later.spawn(async move { replies.into_recv_async().await });
    }

    let mut finished = 0;
    while let Some(results) = accepted.join_next().await {
        let mut results = results.unwrap();
        assert_eq!(results.len(), 1, "an answer was lost: {results:?}");
        match results.remove(0) {
            Ok(results) => {
                let results: Value = serde_json::from_slice(&results.payload().to_bytes()).unwrap();
                assert_eq!(results["ids"].as_array().unwrap().len(), 1500);
                finished += 1;
            }
            // The query is accepted but not begun.
            Err(results) => {
                let results = serde_json::from_slice(&results.payload().to_bytes()).unwrap();
                assert_eq!(reason(&results), (14, "STOPPING"));
            }
        }
    }
    println!("{finished} finished");
    let mut refused = 0;
    while let Some(results) = later.join_next().await {
        if let Ok(reply) = results.unwrap() {
            let refusal = reply.into_result().unwrap_err();
            let refusal = serde_json::from_slice(&refusal.payload().to_bytes()).unwrap();
            assert_eq!(reason(&refusal), (14, "STOPPING"));
            refused += 1;
        }
    }
    assert!(
        refused > 0,
        "a later query gets a refusal in place of no reply"
    );
    let ended = tokio::task::spawn_blocking(|| server.finish())
        .await
        .unwrap();
    assert!(ended.status.success(), "{}", ended.stderr);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_busy_port_is_named_and_off_is_off() {
    let (first, locator) = server();
    let program = env!("CARGO_BIN_EXE_server-process");
    let start = |zenoh: &str| {
        let arguments = [
            "--grpc",
            "127.0.0.1:0",
            "--data",
            "memory",
            "--zenoh",
            zenoh,
        ];
        Process::start(program, &arguments)
    };
    let refused = start(&locator).finish();
    assert_eq!(refused.status.code(), Some(1));
    let address = locator.strip_prefix("tcp/").unwrap();
    assert!(refused.stderr.contains(address), "{}", refused.stderr);
    assert!(refused.stderr.contains("--zenoh off"), "{}", refused.stderr);

    let mut without = start("off");
    assert!(without.line().unwrap().starts_with("listening on http://"));
    assert_eq!(without.line().as_deref(), Some(""));
    drop(first);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn wrong_settings_are_named() {
    for (name, value, part) in [
        ("WAYFOLD_ZENOH__CONFIG", "{ mode: 'king' }", "zenoh.config"),
        ("WAYFOLD_ZENOH__PREFIX", "robots/*", "zenoh.prefix"),
        ("WAYFOLD_ZENOH__PREFIX", "/robots", "zenoh.prefix"),
    ] {
        let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_server-process"));
        command
            .args(["--grpc", "127.0.0.1:0", "--data", "memory"])
            .args(["--zenoh", "tcp/127.0.0.1:0"])
            .env(name, value);
        let finished = Process::spawn(&mut command).finish();
        assert_eq!(finished.status.code(), Some(1));
        assert!(finished.stderr.contains(part), "{}", finished.stderr);
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn two_robots_with_prefixes_of_their_own_share_a_router() {
    let router = crate::robot::session("router", &["tcp/127.0.0.1:0"], &[]).await;
    let at = router.info().locators().await[0].to_string();
    let behind = json!({ "mode": "client", "connect": { "endpoints": [at] } }).to_string();
    let servers = ["one/wayfold", "two/wayfold"].map(|prefix| {
        let settings = [
            ("WAYFOLD_ZENOH__PREFIX", prefix),
            ("WAYFOLD_ZENOH__CONFIG", &behind),
        ];
        (prefix, server_with(&[], &settings))
    });
    let robot = Robot::connect(&at).await;
    for (prefix, _) in &servers {
        let create = json!({ "name": "arm", "space_text": "R1" }).to_string();
        let create_key = format!("{prefix}/create");
        let results = robot.ask(&create_key, create.into_bytes(), Encoding::APPLICATION_JSON);
        assert_eq!(results.await.unwrap().json()["created"], true);
    }
    let both = robot
        .all("*/wayfold/arm/info", Vec::new(), Encoding::APPLICATION_JSON)
        .await;
    assert_eq!(both.len(), 2, "{both:?}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn servers_that_share_a_prefix_warn_of_each_other() {
    let (_router, at) = router("tcp/127.0.0.1:0");
    let behind = json!({ "mode": "client", "connect": { "endpoints": [at] } }).to_string();
    let start = |prefix| {
        let settings = [
            ("WAYFOLD_ZENOH__CONFIG", &*behind),
            ("WAYFOLD_ZENOH__PREFIX", prefix),
        ];
        server_with(&[], &settings).0
    };
    let (other, mut first, mut second) = (start("other"), start("robot"), start("robot"));
    for server in [&mut first, &mut second] {
        server.log_until("another server answers under this prefix");
    }
    let stopped = other.stop(Signal::Terminate);
    assert!(
        !stopped.stderr.contains("another server"),
        "{}",
        stopped.stderr
    );
}
