//! `--timeout` of a load over Zenoh.

use std::net::TcpListener;

use serde_json::Value;

use crate::process::command;

/// A server whose machine has hung: its system takes connections, and nothing answers.
#[test]
fn a_zenoh_server_that_does_not_answer_is_waited_for_until_the_timeout() {
    let silent = TcpListener::bind("127.0.0.1:0").unwrap();
    let locator = format!("tcp/{}", silent.local_addr().unwrap());
    let load = |timeout| {
        let to = ["--face", "zenoh", "--locator", &*locator];
        let load = ["load", "arm", "--json", "--timeout", timeout];
        command("http://127.0.0.1:0", &[&load[..], &to].concat())
    };
    let mut patient = load("1h").spawn().unwrap();
    let _connection = silent.accept().unwrap();
    let ended = load("50ms").output().unwrap();
    let still_waits = patient.try_wait().unwrap().is_none();
    patient.kill().unwrap();
    patient.wait().unwrap();

    assert_eq!(ended.status.code(), Some(4), "{ended:?}");
    let error: Value = serde_json::from_slice(&ended.stderr).unwrap();
    assert_eq!(error["error"]["reason"], "UNREACHABLE", "{error}");
    let message = error["error"]["message"].as_str().unwrap();
    let expected = format!("no Zenoh session to {locator} within 50ms: ");
    assert!(message.starts_with(&expected), "{message}");
    assert!(still_waits, "a wait of an hour ended before one of 50 ms");
}
