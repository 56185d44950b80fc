//! `wayfold-server repair` as an operator runs it: its report and its exit statuses. Beside it, `reseed` without a store.

use std::{
    fs,
    path::Path,
    process::{Command, Output},
    sync::Arc,
};

use bytes::Bytes;
use wayfold_index::PointRef;
use wayfold_server::log::{
    Catalogue, Durability, Effects, Entry, FjallLog, Journal, Outcome, PointStore, Record, Uid,
};

use crate::tables::move_to_tables;

fn repair(directory: &Path, arguments: &[&str]) -> (Option<i32>, String) {
    let server = Command::new(env!("CARGO_BIN_EXE_wayfold-server"));
    repair_by(server, directory, arguments)
}

fn repair_by(mut server: Command, directory: &Path, arguments: &[&str]) -> (Option<i32>, String) {
    let Output {
        status,
        stdout,
        stderr,
    } = server
        .args(["repair", "--log", "off", "--data"])
        .arg(directory)
        .args(arguments)
        .output()
        .unwrap();
    let text = [stdout, stderr].concat();
    (status.code(), String::from_utf8(text).unwrap())
}

fn create(log: &FjallLog, name: &str) -> Uid {
    let uid = Uid::unique();
    log.create(Entry {
        uid,
        name: name.into(),
        space: "R1".parse().unwrap(),
        payload_encoding: Default::default(),
    })
    .unwrap();
    uid
}

/// A closed store with two indices in tables, of which `arm` has three large payloads: each fills a block.
fn fill(directory: &Path) {
    let log = FjallLog::open(directory, Durability::Fsync).unwrap();
    for (name, revisions, bytes) in [("arm", 3, 256 * 1024), ("base", 1, 16)] {
        let uid = create(&log, name);
        for revision in 1..=revisions {
            let mut effects = Effects::new(1);
            let point = PointRef {
                id: revision,
                tag: 0,
                revision,
                row: &[0.5],
            };
            effects.store(point, Outcome::Inserted, Bytes::from(vec![7; bytes]));
            let position = log.view(uid).unwrap().position();
            log.submit(uid, Arc::new(Record::after(position, effects)))
                .unwrap();
        }
    }
    drop(log);
    move_to_tables(directory);
}

/// Flips a bit in the second payload of `arm`. The points come first in the largest table, and the records after them.
fn damage(directory: &Path) {
    flip(directory, |table| table.len() / 4);
}

/// Flips a bit of the largest table.
fn flip(directory: &Path, place: impl FnOnce(&[u8]) -> usize) {
    let tables = fs::read_dir(directory.join("store/keyspaces/1/tables")).unwrap();
    let tables = tables.map(|table| table.unwrap().path());
    let table = tables.max_by_key(|table| fs::metadata(table).unwrap().len());
    let table = table.unwrap();
    let mut bytes = fs::read(&table).unwrap();
    let at = place(&bytes);
    bytes[at] ^= 1;
    fs::write(&table, bytes).unwrap();
}

#[test]
fn a_damaged_store_is_reported_repaired_and_kept() {
    let directory = tempfile::tempdir().unwrap();
    fill(directory.path());
    for arguments in [&["--dry-run"][..], &[]] {
        let (status, text) = repair(directory.path(), arguments);
        assert_eq!(status, Some(0), "{text}");
        assert!(text.contains("is whole: nothing to repair"), "{text}");
        let is_planned = !arguments.is_empty();
        assert_eq!(text.contains("free bytes"), is_planned, "{text}");
    }
    damage(directory.path());
    let (status, text) = repair(directory.path(), &["--dry-run"]);
    assert_eq!(status, Some(1), "{text}");
    for part in ["is damaged: ", "keeps: 1 ind", "loses: arm (", "free bytes"] {
        assert!(text.contains(part), "{part} is missing in\n{text}");
    }
    let kept = directory.path().join("store.damaged-1");
    assert!(!kept.exists());
    let (status, text) = repair(directory.path(), &[]);
    assert_eq!(status, Some(0), "{text}");
    let kept_text = kept.display().to_string();
    for part in ["kept: 1 ind", "lost: arm (", &kept_text, "next: "] {
        assert!(text.contains(part), "{part} is missing in\n{text}");
    }
    assert!(kept.exists());
    let log = FjallLog::open(directory.path(), Durability::Fsync).unwrap();
    for entry in log.indexes().unwrap() {
        assert_eq!(log.view(entry.uid).is_ok(), entry.name == "base");
    }
    let (status, text) = repair(directory.path(), &[]);
    assert_eq!(status, Some(3), "{text}");
    assert!(text.contains("in use"), "{text}");
}

#[test]
fn a_store_that_cannot_be_repaired_is_left_as_it_is() {
    let directory = tempfile::tempdir().unwrap();
    let (status, text) = repair(directory.path(), &[]);
    assert_eq!(status, Some(3), "{text}");
    assert!(text.contains("there is no store in"), "{text}");
    assert_eq!(fs::read_dir(directory.path()).unwrap().count(), 0);
    let (status, text) = repair(Path::new("memory"), &[]);
    assert_eq!(status, Some(2), "{text}");
    assert!(text.contains("name a data directory"), "{text}");
}

/// The entries of both indices are in the damaged block.
#[test]
fn a_repair_does_not_lose_a_deleted_index() {
    let directory = tempfile::tempdir().unwrap();
    let log = FjallLog::open(directory.path(), Durability::Fsync).unwrap();
    let deleted = create(&log, "deleted");
    create(&log, "a-live-index");
    log.delete(deleted).unwrap();
    drop(log);
    move_to_tables(directory.path());
    flip(directory.path(), |table| {
        let mut windows = table.windows(12);
        windows.position(|part| part == b"a-live-index").unwrap()
    });
    let (status, text) = repair(directory.path(), &["--dry-run"]);
    assert_eq!(status, Some(1), "{text}");
    assert!(text.contains("loses: a-live-index ("), "{text}");
    assert_eq!(text.matches("loses: ").count(), 1, "{text}");
}

/// A start fails as the repair does, so neither names the other as the way out.
#[test]
fn a_store_without_its_journal_is_not_sent_to_a_repair() {
    let directory = tempfile::tempdir().unwrap();
    fill(directory.path());
    for file in fs::read_dir(directory.path().join("store")).unwrap() {
        let path = file.unwrap().path();
        if path.extension().is_some_and(|suffix| suffix == "jnl") {
            fs::remove_file(path).unwrap();
        }
    }
    let (status, text) = repair(directory.path(), &[]);
    assert_eq!(status, Some(3), "{text}");
    let log = FjallLog::open(directory.path(), Durability::Fsync).unwrap();
    for why in [text, log.failure().unwrap().to_string()] {
        assert!(why.contains("*.jnl is missing"), "{why}");
        assert!(!why.contains("run `wayfold-server repair`"), "{why}");
    }
}

/// The two stores of a repair have more files than this soft limit.
#[cfg(target_os = "linux")]
#[test]
fn a_repair_raises_the_limit_of_open_files() {
    let directory = tempfile::tempdir().unwrap();
    fill(directory.path());
    damage(directory.path());
    let mut limited = Command::new("sh");
    limited.args(["-c", "ulimit -S -n 8 && exec \"$0\" \"$@\""]);
    limited.arg(env!("CARGO_BIN_EXE_wayfold-server"));
    let (status, text) = repair_by(limited, directory.path(), &[]);
    assert_eq!(status, Some(0), "{text}");
}

#[test]
fn a_reseed_makes_no_directory() {
    let directory = tempfile::tempdir().unwrap();
    let mistyped = directory.path().join("mistyped");
    let output = Command::new(env!("CARGO_BIN_EXE_wayfold-server"))
        .args(["reseed", "arm", "--log", "off", "--data"])
        .arg(&mistyped)
        // Nothing listens there, and nothing is to connect.
        .env("WAYFOLD_CLUSTER__NATS", "nats://127.0.0.1:1")
        .output()
        .unwrap();
    assert_eq!(output.status.code(), Some(1));
    let text = String::from_utf8(output.stderr).unwrap();
    assert!(text.contains("there is no store in"), "{text}");
    assert!(!mistyped.exists());
}
