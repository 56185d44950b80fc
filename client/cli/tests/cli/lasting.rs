//! Verbs that last until a signal or the server ends them.

use std::{
    fs,
    io::{BufRead, BufReader},
    process::Stdio,
};

use serde_json::{Value, json};
use wayfold_proto::{
    snapshot::{Header, Writer},
    v1,
};

use crate::{
    fake::{Fake, UID},
    process::{command, send},
    server::Server,
};

#[tokio::test(flavor = "multi_thread")]
async fn an_interrupted_snapshot_leaves_no_file() {
    let fake = Fake::start().await;
    let header = Header {
        name: "line".into(),
        uid: "past".into(),
        space: "R1".parse().unwrap(),
        revision: 4,
        next_id: 1,
        point_count: 1,
        payload_encoding: Default::default(),
    };
    // The rest of the scan never arrives.
    fake.snapshots(&[Writer::new().header(&header)], false);
    for signal in ["INT", "TERM"] {
        let directory = tempfile::tempdir().unwrap();
        let files = || fs::read_dir(directory.path()).unwrap().count();
        let file = directory.path().join("line.snapshot");
        let mut child = command(&fake.uri, &["snapshot", "line", file.to_str().unwrap()])
            .stdin(Stdio::null())
            .spawn()
            .unwrap();
        while files() == 0 {
            assert!(child.try_wait().unwrap().is_none());
            tokio::task::yield_now().await;
        }
        send(signal, &child);
        let ended = tokio::task::spawn_blocking(move || child.wait_with_output());
        let output = ended.await.unwrap().unwrap();
        assert_eq!(output.status.code(), Some(3), "SIG{signal}");
        assert!(String::from_utf8_lossy(&output.stderr).contains("interrupted"));
        assert_eq!(files(), 0, "SIG{signal}");
    }
}

/// A part of a scan with these points; only one with as many states as ids is good.
fn scanned(ids: &[u64], coordinates: &[f64]) -> v1::ScanResponse {
    v1::ScanResponse {
        points: Some(v1::Points {
            ids: ids.to_vec(),
            states: Some(v1::States {
                row_count: u32::try_from(coordinates.len()).unwrap(),
                coordinates: coordinates.to_vec(),
            }),
            tags: vec![0; ids.len()],
            revisions: vec![1; ids.len()],
            ..Default::default()
        }),
        revision: Some(v1::Revision {
            uid: UID.to_owned(),
            number: 1,
        }),
        point_count: 3,
        held_scan: String::new(),
    }
}

/// A directory with the file `line.csv` of an earlier scan.
fn directory_with_a_file() -> (tempfile::TempDir, std::path::PathBuf) {
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("line.csv");
    fs::write(&file, EARLIER).unwrap();
    (directory, file)
}

const EARLIER: &str = "id,x\n0,0.5\n";

#[tokio::test(flavor = "multi_thread")]
async fn a_scan_that_fails_leaves_the_file_as_it_was() {
    let fake = Fake::start().await;
    let (directory, file) = directory_with_a_file();
    for name in [file, directory.path().join("other.csv")] {
        fake.scan_answers(vec![scanned(&[0], &[0.5]), scanned(&[1, 2], &[1.5])], true);
        let run = command(&fake.uri, &["scan", "line", name.to_str().unwrap()]).output();
        let run = run.unwrap();
        assert_eq!(run.status.code(), Some(3));
        let message = String::from_utf8(run.stderr).unwrap();
        assert!(message.contains("not a state for each id"), "{message}");
        let left: Vec<_> = fs::read_dir(directory.path()).unwrap().collect();
        assert_eq!(left.len(), 1, "{left:?}");
        assert_eq!(
            fs::read_to_string(left[0].as_ref().unwrap().path()).unwrap(),
            EARLIER
        );
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn an_interrupted_scan_leaves_the_file_as_it_was() {
    let fake = Fake::start().await;
    for signal in ["INT", "TERM"] {
        fake.scan_answers(vec![scanned(&[0], &[0.25])], false);
        let (directory, file) = directory_with_a_file();
        let files = || fs::read_dir(directory.path()).unwrap().count();
        let mut child = command(&fake.uri, &["scan", "line", file.to_str().unwrap()])
            .stdin(Stdio::null())
            .spawn()
            .unwrap();
        while files() == 1 && fs::read_to_string(&file).unwrap() == EARLIER {
            assert!(child.try_wait().unwrap().is_none());
            tokio::task::yield_now().await;
        }
        send(signal, &child);
        let ended = tokio::task::spawn_blocking(move || child.wait_with_output());
        let output = ended.await.unwrap().unwrap();
        assert_eq!(fs::read_to_string(&file).unwrap(), EARLIER, "SIG{signal}");
        assert_eq!(files(), 1, "SIG{signal}");
        assert_eq!(output.status.code(), Some(3), "SIG{signal}");
    }
}

#[test]
fn the_command_prints_a_line_a_mutation_until_it_is_interrupted() {
    let server = Server::start();
    server.json(&["create", "line", "--space", "R1"]).line();
    server.run_with(&["insert", "line", "-"], "0.5\n1.5\n");
    let args = ["watch", "line", "--after", "0", "--output", "json"];
    let mut child = command(&server.uri, &args).spawn().unwrap();
    let mut lines = BufReader::new(child.stdout.take().unwrap()).lines();
    let mut line = || serde_json::from_str::<Value>(&lines.next().unwrap().unwrap()).unwrap();
    let first = line();
    let revision = server.revision("line", 1);
    assert_eq!(first["revision"], revision);
    assert_eq!(
        first["stored"],
        json!([
            {"id": 0, "state": [0.5], "tag": 0, "revision": revision},
            {"id": 1, "state": [1.5], "tag": 0, "revision": revision},
        ])
    );
    server.json(&["remove", "line", "1"]).line();
    let second = line();
    assert_eq!(
        (&second["revision"]["number"], &second["removed_ids"]),
        (&json!(2), &json!([1]))
    );
    send("INT", &child);
    assert_eq!(child.wait().unwrap().code(), Some(0));
}

#[test]
fn the_command_says_why_it_cannot_go_on() {
    let server = Server::start();
    server.json(&["create", "line", "--space", "R1"]).line();
    server.run_with(&["insert", "line", "-"], "0.5\n");
    let args = ["watch", "line", "--after", "0"];
    let mut child = command(&server.uri, &args).spawn().unwrap();
    let mut line = String::new();
    let stdout = child.stdout.as_mut().unwrap();
    BufReader::new(stdout).read_line(&mut line).unwrap();
    assert_eq!(line, "revision 1  1 stored  0 removed\n");
    server.json(&["delete", "line"]).line();
    let ended = child.wait_with_output().unwrap();
    assert_eq!(ended.status.code(), Some(3));
    let message = String::from_utf8(ended.stderr).unwrap();
    assert!(message.contains("no index is named \"line\""), "{message}");
}
