//! The snapshots that a server takes by itself: each is whole, and a restored one is the index.

use std::{collections::BTreeSet, fs, path::Path, process::Command};

use wayfold_index::Space;
use wayfold_proto::v1::InsertRequest;
use wayfold_tests::{Content, Process, ServerProcess, Signal, States, Stubs, row_states};

const ROWS: usize = 2_000;

/// A server that takes snapshots every second, and keeps two.
fn server(data: &Path, snapshots: &Path) -> ServerProcess {
    ServerProcess::ready(Process::spawn(&mut server_command(data, snapshots)))
}

fn server_command(data: &Path, snapshots: &Path) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_server-process"));
    command
        .args(["--grpc", "127.0.0.1:0", "--zenoh", "off", "--data"])
        .arg(data)
        .env("WAYFOLD_SNAPSHOT__DIR", snapshots)
        .env("WAYFOLD_SNAPSHOT__EVERY_SECONDS", "1")
        .env("WAYFOLD_SNAPSHOT__KEEP", "2");
    command
}

async fn insert(stubs: &mut Stubs, states: &mut States) {
    let request = InsertRequest {
        index_name: "arm".into(),
        states: Some(row_states(&states.rows(ROWS), 7)),
        payloads: vec!["a payload".into(); ROWS],
        ..Default::default()
    };
    stubs.insert(request).await;
}

/// Waits for the snapshots of four inserts, and returns the file of the last.
async fn take(server: &mut ServerProcess, stubs: &mut Stubs, states: &mut States) -> String {
    let mut newest = String::new();
    for _ in 0..4 {
        insert(stubs, states).await;
        let revision = stubs.describe("arm").await.revision.unwrap().number;
        let end = format!("-{revision}.snapshot");
        let written = server.log_until(&end);
        let line = written.last().unwrap();
        let (_, file) = line.split_once("file=").unwrap();
        newest = file.split_whitespace().next().unwrap().to_owned();
    }
    newest
}

/// Only the user of the server reads a directory and all that is in it.
#[cfg(target_os = "linux")]
fn assert_private(path: &Path) {
    use std::os::unix::fs::PermissionsExt;
    // A file of the store may be gone by now.
    let Ok(found) = fs::metadata(path) else {
        return;
    };
    let mode = found.permissions().mode();
    assert_eq!(mode & 0o077, 0, "{}: {mode:o}", path.display());
    if found.is_dir() {
        for file in fs::read_dir(path).unwrap() {
            assert_private(&file.unwrap().path());
        }
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn snapshots_are_taken_kept_and_restored() {
    let directory = tempfile::tempdir().unwrap();
    let (data, snapshots) = (directory.path().join("data"), directory.path().join("kept"));
    let mut states = States::new(Space::se3(), 29);
    let mut server = server(&data, &snapshots);
    let mut stubs = Stubs::connect(server.uri()).await;
    stubs.create("arm", "R3*SO3:0.15").await;
    let newest = take(&mut server, &mut stubs, &mut states).await;
    #[cfg(target_os = "linux")]
    for directory in [&data, &snapshots] {
        assert_private(directory);
    }
    let content = Content::read(&stubs, "arm").await.unwrap();
    let uri = server.uri().to_owned();
    let wayfold = |arguments: &[&str]| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_cli-process"));
        let output = command.args(["--server", &uri]).args(arguments).output();
        let output = output.unwrap();
        assert!(output.status.success(), "{output:?}");
    };
    wayfold(&["restore", "copy", &newest]);
    let mut copy = Content::read(&stubs, "copy").await.unwrap();
    copy.uid.clone_from(&content.uid);
    assert_eq!(copy, content);
    let files = || {
        let files = fs::read_dir(snapshots.join("arm")).unwrap();
        let files = files.map(|file| file.unwrap().path());
        files.collect::<BTreeSet<_>>()
    };
    // Those of an index that is deleted stay, also once its name has another.
    stubs.delete("arm").await;
    let deleted = files();
    assert_eq!(deleted.len(), 2, "{deleted:?}");
    assert!(deleted.contains(Path::new(&newest)), "{deleted:?}");
    stubs.create("arm", "R3*SO3:0.15").await;
    take(&mut server, &mut stubs, &mut states).await;
    server.stop(Signal::Terminate);
    assert!(files().is_superset(&deleted), "{:?}", files());
    assert_eq!(files().len(), 4, "{:?}", files());
}

#[test]
fn two_servers_do_not_share_a_directory() {
    let directory = tempfile::tempdir().unwrap();
    let [one, other, snapshots] = ["one", "other", "kept"].map(|name| directory.path().join(name));
    let first = server(&one, &snapshots);
    let mut command = server_command(&other, &snapshots);
    let second = Process::spawn(&mut command).finish();
    assert_eq!(second.status.code(), Some(1));
    let text = second.stderr;
    assert!(
        text.contains("another server") && text.contains("snapshot.dir"),
        "{text}"
    );
    first.stop(Signal::Terminate);
}

#[test]
fn a_directory_that_it_cannot_have_is_named() {
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("file");
    fs::write(&file, "").unwrap();
    let data = directory.path().join("data");
    // The first may be another in a moment, and the settings are wrong in the others.
    for (snapshots, part, status) in [
        (file.join("kept"), "cannot write", 1),
        (data.join("kept"), "in data.dir", 2),
        (directory.path().to_owned(), "holds it", 2),
    ] {
        let mut command = Command::new(env!("CARGO_BIN_EXE_server-process"));
        command
            .args(["--grpc", "127.0.0.1:0", "--zenoh", "off", "--data"])
            .arg(&data)
            .env("WAYFOLD_SNAPSHOT__DIR", snapshots);
        let ended = Process::spawn(&mut command).finish();
        assert_eq!(ended.status.code(), Some(status));
        assert!(ended.stderr.contains("snapshot.dir"), "{}", ended.stderr);
        assert!(ended.stderr.contains(part), "{}", ended.stderr);
    }
    assert!(!data.exists());
}
