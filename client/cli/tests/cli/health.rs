//! `wayfold health` and `wayfold server`.

use std::time::Duration;

use serde_json::json;
use tokio::net::TcpListener;
use tokio_stream::wrappers::TcpListenerStream;
use tonic::{Code, Status};
use tonic_health::{ServingStatus, server::health_reporter};
use tonic_types::{ErrorDetails, StatusExt};

use crate::{
    fake::Fake,
    process::{command, run_alone},
    server::Server,
};

#[test]
fn a_server_that_serves_is_healthy() {
    let server = Server::start();
    // The server is ready once it has answered a call.
    server.json(&["list"]).lines();
    let health = server.json(&["health"]);
    assert_eq!(
        health.line(),
        json!({"server": server.uri, "serving": true})
    );
    let health = server.run(&["health"]);
    assert_eq!(health.stdout, format!("{} serves\n", server.uri));
}

#[test]
fn one_option_names_several_servers() {
    let server = Server::start();
    server.json(&["list"]).lines();
    let several = format!("http://127.0.0.1:0,{}", server.uri);
    let run = command(&several, &["health"]).output().unwrap();
    assert_eq!(run.status.code(), Some(0));
    let said = String::from_utf8(run.stdout).unwrap();
    assert_eq!(said, format!("{several} serves\n"));
}

#[tokio::test(flavor = "multi_thread")]
async fn a_server_that_does_not_serve_is_status_1() {
    let (reporter, service) = health_reporter();
    let not_serving = ServingStatus::NotServing;
    reporter.set_service_status("", not_serving).await;
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let uri = format!("http://{}", listener.local_addr().unwrap());
    let serving = tonic::transport::Server::builder()
        .add_service(service)
        .serve_with_incoming(TcpListenerStream::new(listener));
    tokio::spawn(serving);

    let run = command(&uri, &["health", "--output", "json"]).output();
    let run = run.unwrap();
    assert_eq!(run.status.code(), Some(1));
    let lines = |bytes: &[u8]| serde_json::from_slice::<serde_json::Value>(bytes).unwrap();
    assert_eq!(lines(&run.stdout), json!({"server": uri, "serving": false}));
    let error = &lines(&run.stderr)["error"];
    assert_eq!(
        (&error["code"], &error["reason"]),
        (&json!("UNAVAILABLE"), &json!("NOT_SERVING"))
    );
    let run = command(&uri, &["health"]).output().unwrap();
    assert_eq!((run.status.code(), &*run.stdout), (Some(1), &b""[..]));
    let said = String::from_utf8(run.stderr).unwrap();
    let expected = format!(
        "error: {uri} does not serve: it is starting or stopping, or its store cannot be read\n"
    );
    assert_eq!(said, expected);
}

/// A longer wait would not help, so that the error names no `--timeout`.
#[tokio::test(flavor = "multi_thread")]
async fn a_call_to_a_server_that_stops_is_status_4() {
    let fake = Fake::start().await;
    fake.fail(|_, _| {
        let mut details = ErrorDetails::with_error_info("STOPPING", "wayfold", []);
        // The client makes no further attempt: the pause exceeds its timeout.
        details.set_retry_info(Some(Duration::from_secs(60)));
        let stopping = "the server is stopping";
        Some(Status::with_error_details(
            Code::Unavailable,
            stopping,
            details,
        ))
    });
    let run = command(&fake.uri, &["list"]).output().unwrap();
    assert_eq!(run.status.code(), Some(4), "{run:?}");
    let said = String::from_utf8(run.stderr).unwrap();
    assert_eq!(said, "error: the server is stopping (UNAVAILABLE)\n");
    let run = command(&fake.uri, &["list", "--output", "json"]).output();
    let error: serde_json::Value = serde_json::from_slice(&run.unwrap().stderr).unwrap();
    assert_eq!(
        (&error["error"]["code"], &error["error"]["reason"]),
        (&json!("UNAVAILABLE"), &json!("STOPPING"))
    );
}

#[test]
fn no_server_is_status_4() {
    run_alone(&["health", "--timeout", "50ms"]).error(4);
}

#[test]
fn a_server_describes_itself() {
    let server = Server::start();
    let info = server.json(&["server"]).line();
    let expected = json!({
        "server": server.uri, "version": env!("CARGO_PKG_VERSION"), "durability": "memory", "limits": info["limits"],
    });
    assert_eq!(info, expected);
    // The documented limit.
    assert_eq!(info["limits"]["max_payload_bytes"], 64 * 1024);
    let text = server.run(&["server"]).stdout;
    for line in [
        &format!("server      {}\n", server.uri),
        "durability  memory; ",
        "a payload   64.00 KiB\n",
    ] {
        assert!(text.contains(line), "{text} has no {line:?}");
    }
}
