//! Pipes: rows that come one by one, many rows, and readers that leave.

use std::{
    io::{BufRead, BufReader, Read, Write},
    process::Stdio,
};

use serde_json::json;
use wayfold::Client;

use crate::{
    process::{closed_pipe, command, shell},
    server::Server,
};

#[test]
fn a_row_in_a_pipe_is_answered_before_the_next_is_written() {
    let server = Server::start();
    server.run(&["create", "line", "--space", "R1"]);
    server.run_with(&["insert", "line", "-"], "0\n10\n20\n");
    let mut asking = command(
        &server.uri,
        &["knn", "line", "-", "-k", "1", "--output", "json"],
    )
    .spawn()
    .unwrap();
    let mut stdin = asking.stdin.take().unwrap();
    let mut answers = BufReader::new(asking.stdout.take().unwrap()).lines();
    for (row, id) in [("1\n", 0), ("19\n", 2), ("11\n", 1)] {
        stdin.write_all(row.as_bytes()).unwrap();
        let answer: serde_json::Value =
            serde_json::from_str(&answers.next().unwrap().unwrap()).unwrap();
        assert_eq!(answer["ids"], json!([id]));
    }
    drop(stdin);
    assert!(answers.next().is_none());
    assert!(asking.wait().unwrap().success());
}

#[tokio::test(flavor = "multi_thread")]
async fn answers_keep_the_order_of_a_long_file() {
    let server = Server::start();
    let line = server.index("line", "R1").await;
    line.insert((0..5000).map(|x| [f64::from(x)]))
        .await
        .unwrap();
    let queries: Vec<u32> = (0..3000).map(|i| i * 7919 % 5000).collect();
    let rows: String = queries.iter().map(|x| format!("{x}.25\n")).collect();
    let lines = server
        .json_with(&["knn", "line", "-", "-k", "1"], &rows)
        .lines();
    let found: Vec<u64> = lines
        .iter()
        .map(|line| line["ids"][0].as_u64().unwrap())
        .collect();
    assert_eq!(
        found,
        queries.iter().map(|x| u64::from(*x)).collect::<Vec<_>>()
    );
}

#[tokio::test(flavor = "multi_thread")]
async fn a_closed_pipe_ends_a_scan_quietly() {
    let server = Server::start();
    let line = server.index("line", "R1").await;
    // Far more than a pipe holds.
    line.insert((0..50_000).map(|x| [f64::from(x)]))
        .await
        .unwrap();
    let mut scan = command(&server.uri, &["scan", "line"]).spawn().unwrap();
    let mut first = String::new();
    let mut stdout = BufReader::new(scan.stdout.take().unwrap());
    stdout.read_line(&mut first).unwrap();
    drop(stdout);
    assert_eq!(first, "id,x\n");
    assert!(scan.wait().unwrap().success());
    let mut errors = String::new();
    scan.stderr
        .take()
        .unwrap()
        .read_to_string(&mut errors)
        .unwrap();
    assert_eq!(errors, "");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_closed_pipe_does_not_end_an_insert() {
    let server = Server::start();
    server.index("line", "R1").await;
    let mut insert = command(
        &server.uri,
        &["insert", "line", "-", "--knn", "5", "--output", "json"],
    );
    let mut insert = insert.stderr(Stdio::null()).spawn().unwrap();
    let rows: String = (0..5000).map(|x| format!("{x}\n")).collect();
    drop(insert.stdout.take());
    insert
        .stdin
        .take()
        .unwrap()
        .write_all(rows.as_bytes())
        .unwrap();
    assert!(insert.wait().unwrap().success());
    let client = Client::connect(&server.uri).await.unwrap();
    assert_eq!(client.index_info("line").await.unwrap().point_count, 5000);
}

/// The entry is lost, and the token is of no use without it.
#[test]
fn a_token_whose_entry_no_one_reads_is_an_error() {
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("cell.token");
    let args = ["token", "create", "cell", "--role", "read", "--to"];
    let mut create = command(
        "http://127.0.0.1:0",
        &[&args[..], &[file.to_str().unwrap()]].concat(),
    );
    let output = create.stdout(closed_pipe()).output().unwrap();
    assert_eq!(output.status.code(), Some(3), "{output:?}");
    let error = String::from_utf8_lossy(&output.stderr);
    assert!(error.contains("standard output"), "{error}");
    assert!(!file.exists());
}

#[test]
fn an_insert_whose_answers_cannot_be_written_says_what_is_stored() {
    let server = Server::start();
    server.run(&["create", "line", "--space", "R1"]);
    let script = "seq 3000 | \"$0\" insert line - --knn 3 > /dev/full";
    let full = shell(&server.uri, script);
    let stored = full
        .error(3)
        .contains("the first 1000 of 3000 rows took effect");
    assert!(stored, "{}", full.stderr);
    let info = server.json(&["info", "line"]).line();
    assert_eq!(info["point_count"], 1000);
}
