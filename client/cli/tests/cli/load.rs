//! The verb `load`: its counts are those of the server, and it leaves the index as it was.

mod files;
#[cfg(feature = "zenoh")]
mod zenoh;

use std::{
    fs,
    sync::atomic::{AtomicUsize, Ordering},
};

use serde_json::{Value, json};

use crate::{
    fake::Fake,
    process::{closed_pipe, command, run_alone},
    server::Server,
};

/// The number of points of an index.
fn point_count(server: &Server, index: &str) -> Value {
    server.json(&["info", index]).line()["point_count"].clone()
}

fn number(value: &Value) -> u64 {
    value.as_u64().expect("a whole number")
}

#[test]
fn the_counts_are_those_of_the_server() {
    let server = Server::start();
    server.run(&["create", "arm", "--space", "R3*SO3:0.15"]);
    let args = "load arm --calls 300 --batch 5 --workers 3 --fill 40 --seed 9 --keep --json";
    let args: Vec<&str> = args.split(' ').collect();
    let result = server.run(&args).line();
    let total = &result["total"];
    assert_eq!(
        (&total["calls"], &total["failed"]),
        (&json!(300), &json!(0))
    );
    let verbs = total["verbs"].as_object().unwrap();
    let calls: u64 = verbs.values().map(|verb| number(&verb["calls"])).sum();
    assert_eq!(calls, 300);
    let inserts = number(&verbs["insert"]["answered"]);
    assert!(inserts > 0);
    assert_eq!(point_count(&server, "arm"), 40 + 5 * inserts);
    // Each answered insert made one revision.
    assert_eq!(server.revision("arm", 1 + inserts)["number"], 1 + inserts);
    let expected = json!({
        "before": 0, "filled": 40, "inserted": 5 * inserts, "removed": 0, "after": 40 + 5 * inserts, "unsent": 0,
        "flush_s": result["points"]["flush_s"],
    });
    assert_eq!(result["points"], expected);
    // The tag of the result selects the points of the run.
    let tag = result["tag"].as_str().unwrap();
    let tagged = server.json(&["scan", "arm", "--tag", tag]).lines();
    assert_eq!(tagged.len() as u64, 40 + 5 * inserts);
}

#[test]
fn equal_seeds_make_equal_calls_whatever_the_number_of_workers() {
    let server = Server::start();
    let verbs = |index: &str, workers: &str, seed: &str| {
        server.run(&["create", index, "--space", "R2*SO2"]);
        let calls = ["load", index, "--calls", "200", "--keep", "--json"];
        let result = server.run(&[&calls[..], &["--workers", workers, "--seed", seed]].concat());
        let verbs = result.line()["total"]["verbs"].clone();
        let verbs = verbs.as_object().unwrap().clone();
        let counts = verbs
            .iter()
            .map(|(name, of)| (name.clone(), number(&of["calls"])));
        let mut states: Vec<String> = server
            .json(&["scan", index])
            .lines()
            .iter()
            .map(|point| point["state"].to_string())
            .collect();
        states.sort();
        (counts.collect::<Vec<_>>(), states)
    };
    let one = verbs("one", "1", "5");
    assert_eq!(one, verbs("two", "4", "5"));
    assert_ne!(one, verbs("three", "1", "6"));
}

#[test]
fn a_run_leaves_the_index_as_it_was() {
    let server = Server::start();
    server.run(&["create", "line", "--space", "R1"]);
    server.run_with(&["insert", "line", "-", "--tag", "7"], "0.25\n0.5\n0.75\n");
    let points = || {
        server
            .run(&["scan", "line", "--include", "states,tags"])
            .stdout
    };
    let before = points();
    for face in ["grpc", "shared"] {
        let args = [
            "load",
            "line",
            "--calls",
            "400",
            "--mix",
            "insert=1,get=1",
            "--json",
        ];
        let more = ["--face", face, "--warmup", "100ms", "--batch", "3"];
        let result = server.run(&[&args[..], &more].concat()).line();
        assert_eq!(result["total"]["failed"], 0, "{face}: {result}");
        let counts = &result["points"];
        assert!(
            number(&counts["inserted"]) >= 3 * number(&result["total"]["verbs"]["insert"]["calls"])
        );
        assert_eq!(counts["removed"], counts["inserted"], "{face}");
        assert_eq!(
            (&counts["before"], &counts["after"]),
            (&json!(3), &json!(3))
        );
        assert_eq!(points(), before, "{face}");
    }
}

#[test]
fn a_table_is_for_people() {
    let server = Server::start();
    server.run(&["create", "arm", "--space", "R3"]);
    let run = server.run(&["load", "arm", "--rate", "500", "--duration", "1s"]);
    assert_eq!((run.status, &*run.stderr), (Some(0), ""));
    for part in [
        "arm in R3, over gRPC at http://127.0.0.1:",
        "open loop at 500 calls/s, 8 workers, 1 state a call, insert=1,knn=8,query=1,get=1, ",
        "P99.9",
        "500 calls were due; latency counts from the due time",
        "points: 0 before, 1,000 stored first",
        "removed, 0 now",
    ] {
        assert!(run.stdout.contains(part), "{} has no {part:?}", run.stdout);
    }
    let closed = server.run(&["load", "arm", "--calls", "50", "--mix", "knn=1"]);
    assert!(closed.stdout.contains("closed loop"), "{}", closed.stdout);
}

#[test]
fn refusals_of_a_quota_are_counted() {
    let server = Server::with(|config| config.limits.max_points_per_index = 100);
    server.run(&["create", "line", "--space", "R1"]);
    let args = [
        "load", "line", "--mix", "insert=1", "--calls", "250", "--keep", "--json",
    ];
    let result = server.run(&args).line();
    let insert = &result["total"]["verbs"]["insert"];
    assert_eq!(
        (&insert["calls"], &insert["answered"]),
        (&json!(250), &json!(100))
    );
    assert_eq!(insert["failed"], 150);
    let failures = insert["failures"].as_array().unwrap();
    assert_eq!(failures.len(), 1, "{insert}");
    let failure = &failures[0];
    assert_eq!(
        (&failure["kind"], &failure["reason"], &failure["count"]),
        (&json!("refused"), &json!("QUOTA_EXCEEDED"), &json!(150))
    );
    assert_eq!(point_count(&server, "line"), 100);
}

#[tokio::test(flavor = "multi_thread")]
async fn every_refusal_of_a_server_is_counted_once() {
    let fake = Fake::start().await;
    // Every third search of one state; calls about the index have no states.
    let searches = AtomicUsize::new(0);
    fake.fail(move |_, rows| {
        let fails = rows == 1 && searches.fetch_add(1, Ordering::Relaxed).is_multiple_of(3);
        fails.then(|| tonic::Status::resource_exhausted("busy"))
    });
    let args = "load line --mix knn=1 --calls 60 --workers 1 --fill 0 --json";
    let args: Vec<&str> = args.split(' ').collect();
    let run = command(&fake.uri, &args).output().unwrap();
    let errors = String::from_utf8_lossy(&run.stderr);
    let result: Value = serde_json::from_slice(&run.stdout).expect(&errors);
    let failures = &result["total"]["failures"];
    assert_eq!(failures[0]["kind"], "refused");
    assert_eq!(failures[0]["reason"], "RESOURCE_EXHAUSTED");
    assert_eq!(failures[0]["count"], 20, "{result}");
    assert_eq!(result["total"]["answered"], 40);
    assert!(failures[0]["first"].as_str().unwrap().contains("busy"));

    // Without any answer the result is printed, and the status is that of a failure.
    fake.fail(|_, rows| (rows == 1).then(|| tonic::Status::internal("broken")));
    let run = command(&fake.uri, &args).output().unwrap();
    let result: Value = serde_json::from_slice(&run.stdout).unwrap();
    assert_eq!(result["total"]["failed"], 60);
    assert_eq!(run.status.code(), Some(3));
    let error = String::from_utf8_lossy(&run.stderr);
    assert!(error.contains("none of 60 calls was answered"), "{error}");

    // Nor does a reader that leaves hide it, with more figures than the buffer of the output holds.
    let directory = tempfile::tempdir().unwrap();
    let scenario = directory.path().join("long.toml");
    fs::write(&scenario, "[[phase]]\nname = \"short\"\n".repeat(40)).unwrap();
    let args = [&args[..], &["--scenario", scenario.to_str().unwrap()]].concat();
    let mut long = command(&fake.uri, &args);
    assert!(long.output().unwrap().stdout.len() > 8192);
    let run = long.stdout(closed_pipe()).output().unwrap();
    assert_eq!(run.status.code(), Some(3), "{run:?}");
}

#[test]
fn wrong_settings_say_what_to_do() {
    let server = Server::start();
    server.run(&["create", "line", "--space", "R1"]);
    for (args, status, expected) in [
        ("nope", 3, "no index is named \"nope\""),
        ("line --rate 0", 2, "leave --rate out for a closed loop"),
        ("line --mix knn", 2, "knn has no weight: write knn=1"),
        (
            "line --mix kn=1",
            2,
            "the verbs are insert, knn, query, get, stream",
        ),
        ("line --mix knn=0", 2, "every weight is 0"),
        ("line --workers 0", 2, "a whole number from 1 to 1024"),
        ("line --face zenoh", 2, "--face zenoh needs --locator"),
        (
            "line --locator tcp/127.0.0.1:1",
            2,
            "--locator is for --face zenoh",
        ),
        ("line --range 1,0", 2, "two numbers, the smaller first"),
        (
            "line --fill 0 --mix get=1",
            3,
            "get needs some: leave out --fill 0",
        ),
        (
            "line --scenario /no/such.toml",
            3,
            "cannot read the scenario /no/such.toml",
        ),
    ] {
        let args = format!("load {args}");
        let args: Vec<&str> = args.split(' ').collect();
        let run = server.run(&args);
        assert!(run.error(status).contains(expected), "{}", run.stderr);
    }
    assert_eq!(point_count(&server, "line"), 0);
    let error = server.run(&["load", "nope", "--json"]).json_error(3);
    assert_eq!(error["code"], "NOT_FOUND");
    let error = run_alone(&["load", "line", "--json", "--rate", "0"]).json_error(2);
    assert_eq!(error["reason"], "USAGE");
    run_alone(&["load", "line", "--timeout", "50ms"]).error(4);
}
