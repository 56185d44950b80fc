//! The passwords in the settings of libraries stay out of their lines in the log.

use std::{net::TcpListener, process::Command};

use wayfold_tests::{Process, ServerProcess, Signal};

use super::assert_secret;

const PASSWORD: &str = "s3cretPW";

/// A server that writes all lines that there are.
fn talkative(arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_server-process"));
    command
        .args(["--grpc", "127.0.0.1:0", "--data", "memory"])
        .args(arguments)
        .env("WAYFOLD_LOG__FILTER", "trace,zenoh=trace,async_nats=trace");
    command
}

#[test]
fn a_password_for_zenoh_is_in_no_line() {
    let auth = serde_json::json!({ "transport": { "auth": { "usrpwd": {
        "user": "robot", "password": PASSWORD,
    } } } });
    let mut command = talkative(&["--zenoh", "tcp/127.0.0.1:0"]);
    command.env("WAYFOLD_ZENOH__CONFIG", auth.to_string());
    let server = ServerProcess::ready(Process::spawn(&mut command));
    let log = server.stop(Signal::Terminate).stderr;
    assert_secret(PASSWORD, &log);
}

#[test]
fn a_key_in_an_endpoint_of_zenoh_is_in_no_line() {
    // The listener is dropped at once: no router answers at its port.
    let closed = TcpListener::bind("127.0.0.1:0").unwrap().local_addr();
    let closed = closed.unwrap();
    let endpoints = ["127.0.0.1", "[::ffff:127.0.0.1]"];
    let endpoints = endpoints.map(|host| {
        let port = closed.port();
        format!("tls/{host}:{port}#connect_private_key_base64={PASSWORD}")
    });
    let connect = serde_json::json!({ "connect": { "endpoints": endpoints } });
    let mut command = talkative(&["--zenoh", "tcp/127.0.0.1:0", "--insecure"]);
    command.env("WAYFOLD_ZENOH__CONFIG", connect.to_string());
    let mut server = Process::spawn(&mut command);
    server.log_until("no Zenoh router or peer is reached yet");
    let ended = server.stop(Signal::Kill);
    assert!(
        ended.stderr.contains("[::ffff:127.0.0.1]"),
        "{}",
        ended.stderr
    );
    assert!(!ended.stderr.contains(PASSWORD), "the key is in the log");
    assert!(!ended.stdout.concat().contains(PASSWORD));
}

/// Zenoh itself warns of links that do not open, and names their locators.
#[test]
fn a_key_in_a_locator_that_fails_is_in_no_line() {
    let taken = TcpListener::bind("127.0.0.1:0").unwrap();
    let port = taken.local_addr().unwrap().port();
    let option = |name: &str| format!("tls/127.0.0.1:{port}#{name}_private_key_base64={PASSWORD}");
    let client = serde_json::json!({
        "mode": "client",
        "connect": { "endpoints": [option("connect")], "timeout_ms": 0 },
    });
    for (listen, config) in [
        (option("listen"), "{}".to_owned()),
        ("tcp/127.0.0.1:0".to_owned(), client.to_string()),
    ] {
        let mut command = talkative(&["--zenoh", &listen]);
        command
            .env("WAYFOLD_ZENOH__CONFIG", config)
            .env("WAYFOLD_LOG__FILTER", "info,zenoh=warn");
        let ended = Process::spawn(&mut command).finish();
        assert_eq!(ended.status.code(), Some(1), "{}", ended.stderr);
        assert!(ended.stderr.contains("Zenoh"), "{}", ended.stderr);
        assert!(!ended.stderr.contains(PASSWORD), "{}", ended.stderr);
    }
}

#[test]
fn a_password_for_nats_is_in_no_line() {
    // The listener is dropped at once: no server answers at its port.
    let closed = TcpListener::bind("127.0.0.1:0").unwrap().local_addr();
    let nats = format!("nats://user:{PASSWORD}@{}", closed.unwrap());
    let mut command = talkative(&[]);
    command
        .env("WAYFOLD_CLUSTER__NATS", nats)
        .env("WAYFOLD_CLUSTER__LISTEN", "127.0.0.1:0");
    let mut server = Process::spawn(&mut command);
    server.log_until("trying again");
    let log = server.stop(Signal::Kill).stderr;
    assert!(!log.contains(PASSWORD), "the password is in the log");
}
