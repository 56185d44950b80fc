//! A directory of version 3, from before there were writer sessions, is opened with everything in it and becomes one of
//! version 4.
//!
//! `version-3/` is such a directory as a server left it. In `arm` the operation `first` inserted the points 0 to 2,
//! another call point 10, an update changed point 1, and the operation `second` removed the points 2 and 10. In `leg`
//! the operation `third` inserted the points 0 and 1, and another call removed point 1.

use std::fs;

use wayfold_server::log::{Catalogue, Effects, FjallLog, PointStore, repair};

use super::{
    all_points,
    copied::copied,
    disk::{JournalFile, Part, dump, index, marker, of_version, open, with_batch},
    effects, submit, synced,
};

/// The content of the directory, as [`dump`] writes it.
const CONTENT: &str = include_str!("version-3.txt");

/// Opens session 3 of `leg` and writes its first batch.
fn write_batches(log: &FjallLog) {
    let leg = index(log, "leg");
    submit(
        log,
        leg.uid,
        2,
        with_batch(Effects::new(1), (3, 0), 2..5, &[]),
    )
    .unwrap();
    submit(
        log,
        leg.uid,
        3,
        with_batch(effects(4, &[3], &[]), (3, 1), 5..8, &[]),
    )
    .unwrap();
    synced(log, leg.uid, 4).unwrap();
}

/// Asserts that the batches and all that was stored before them are there.
fn check_batches(log: &FjallLog) {
    assert_eq!((log.lost(), log.failure()), (Vec::new(), None));
    let view = log.view(index(log, "leg").uid).unwrap();
    assert_eq!((view.revision(), view.next_id()), (4, 8));
    let ids: Vec<u64> = all_points(&*view).into_keys().collect();
    assert_eq!(ids, [0, 3]);
    let sessions = view.sessions();
    let session = sessions.get(3).unwrap();
    assert_eq!(
        (session.batch, &session.response[..]),
        (1, &b"batch 1 of 3"[..])
    );
    let owners = [1, 2, 7, 8].map(|id| sessions.owner(id));
    assert_eq!(owners, [None, Some(3), Some(3), None]);
    let arm = log.view(index(log, "arm").uid).unwrap();
    assert_eq!(all_points(&*arm).len(), 2);
}

#[test]
fn a_directory_of_version_3_is_opened_and_takes_batches() {
    for ended_cleanly in [true, false] {
        let directory = of_version(3);
        let path = directory.path();
        if !ended_cleanly {
            fs::remove_file(path.join("journal-synced")).unwrap();
        }
        let log = open(path);
        assert_eq!(marker(path), "wayfold-server data, version 4\n");
        assert_eq!(dump(&log), CONTENT);
        drop(log);
        let log = open(path);
        assert_eq!(dump(&log), CONTENT);
        write_batches(&log);
        check_batches(&log);
        // A crash leaves this content.
        check_batches(&open(copied(path).path()));
        drop(log);
        check_batches(&open(path));
        assert_eq!(marker(path), "wayfold-server data, version 4\n");
    }
}

#[test]
fn an_interrupted_upgrade_is_completed() {
    let directory = of_version(3);
    let path = directory.path();
    write_batches(&open(path));
    for left in [
        "wayfold-server data, version 3\n",
        "wayfold-server data, version 3",
    ] {
        fs::write(path.join("wayfold-data"), left).unwrap();
        check_batches(&open(path));
        assert_eq!(marker(path), "wayfold-server data, version 4\n");
    }
}

#[test]
fn a_damaged_directory_of_version_3_stays_one() {
    let directory = of_version(3);
    let path = directory.path();
    let journal = Part::of(path, JournalFile::of(path).name);
    journal.take_away();
    assert!(!open(path).lost().is_empty());
    assert_eq!(marker(path), "wayfold-server data, version 3\n");
    journal.bring_back();
    assert_eq!(dump(&open(path)), CONTENT);
    assert_eq!(marker(path), "wayfold-server data, version 4\n");
}

#[test]
fn repair_reads_a_directory_of_version_3_and_leaves_the_version() {
    let directory = of_version(3);
    for dry_run in [true, false] {
        let report = repair(directory.path(), dry_run).unwrap();
        assert_eq!((report.damage, report.whole), (None, 2));
        // The next start does not rewrite the journal.
        assert!(directory.path().join("journal-synced").exists());
    }
    // The server that wrote it still opens it.
    assert_eq!(marker(directory.path()), "wayfold-server data, version 3\n");
    assert_eq!(dump(&open(directory.path())), CONTENT);
}
