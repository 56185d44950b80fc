//! `wayfold-server repair` as an operator runs it: its report and its exit statuses. Beside it, `reseed` without a store.

use std::{
    fs::{self, File},
    path::Path,
    process::{Command, Output},
};

use wayfold_server::log::{Catalogue, Durability, FjallLog, PointStore};

use crate::tables::{created, flip, grow, in_tables, move_to_tables, payload, places};

/// The bytes of a payload that fills a block of its own.
const PAYLOAD: usize = 256 * 1024;

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

/// A closed store with two indices in tables.
fn fill(directory: &Path) {
    in_tables(directory, "arm", &[1..=3], PAYLOAD);
    in_tables(directory, "base", &[1..=1], 16);
}

/// Flips a bit in the second payload of `arm`.
fn damage(directory: &Path) {
    damage_at(directory, &payload(2, PAYLOAD));
}

/// Flips a bit of the first of these bytes.
fn damage_at(directory: &Path, bytes: &[u8]) {
    let (table, at) = places(directory, bytes).swap_remove(0);
    flip(&table, at);
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
    let deleted = created(&log, "deleted");
    created(&log, "a-live-index");
    log.delete(deleted.uid).unwrap();
    drop(log);
    move_to_tables(directory.path());
    damage_at(directory.path(), b"a-live-index");
    let (status, text) = repair(directory.path(), &["--dry-run"]);
    assert_eq!(status, Some(1), "{text}");
    assert!(text.contains("loses: a-live-index ("), "{text}");
    assert_eq!(text.matches("loses: ").count(), 1, "{text}");
}

/// A clean stop had synced these revisions, so a cut journal has lost acknowledged mutations.
#[test]
fn lost_revisions_are_reported_though_every_byte_can_be_read() {
    let directory = tempfile::tempdir().unwrap();
    fill(directory.path());
    let log = FjallLog::open(directory.path(), Durability::Fsync).unwrap();
    let cut = created(&log, "cut");
    for id in 1..=3 {
        grow(&log, cut.uid, payload(id, 64)).unwrap();
    }
    drop(log);
    for file in fs::read_dir(directory.path().join("store")).unwrap() {
        let path = file.unwrap().path();
        if path.extension().is_some_and(|suffix| suffix == "jnl") {
            let journal = File::options().write(true).open(path).unwrap();
            journal
                .set_len(journal.metadata().unwrap().len() / 2)
                .unwrap();
        }
    }
    let beyond = [
        "beyond repair: cut (the revisions 1 to 3 were",
        "restore the index",
        "cannot bring",
    ];
    for (arguments, kept) in [
        (&["--dry-run"][..], None),
        (&[], None),
        (&[], Some("kept: 1 ind")),
    ] {
        if kept.is_some() {
            damage(directory.path());
        }
        let (status, text) = repair(directory.path(), arguments);
        assert_eq!(status, Some(1), "{text}");
        assert!(!text.contains("is whole"), "{text}");
        for part in beyond.into_iter().chain(kept) {
            assert!(text.contains(part), "{part} is missing in\n{text}");
        }
    }
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
    assert!(text.contains("lost: arm ("), "{text}");
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
