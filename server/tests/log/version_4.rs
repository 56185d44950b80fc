//! A directory of version 4, with writer sessions, is opened with everything in it.
//!
//! `version-4/` is such a directory as it was left when version 4 was current. In `arm` the operation `first` inserted
//! the points 0 to 2 (revision 1). Session 2 was opened with the ids 3 to 5 (revision 2), and its batch 1 stored
//! point 3 (revision 3). Session 4 was opened with the ids 6 and 7 (revision 4). The operation `second` removed point 1
//! (revision 5), and the records up to revision 3 and the operation `first` were trimmed. Batch 2 of session 2 stored
//! point 0 again, reserved the id 8 and ended session 4 (revision 6). In `leg` session 1 was opened with the ids 0 to 3.
//! An index `gone` was created and deleted.

use std::fs;

use wayfold_server::log::{FjallLog, Journal, LogError, PointStore, repair};

use super::{
    all_points,
    disk::{dump, index, of_version, open, with_batch},
    effects, submit, synced,
};

/// The content of the directory, as [`dump`] writes it.
const CONTENT: &str = include_str!("version-4.txt");

/// Writes the next batch of session 2, and asserts that it took the session's place.
fn check_next_batch(log: &FjallLog) {
    let uid = index(log, "arm").uid;
    let next = with_batch(effects(7, &[4], &[]), (2, 3), 9..11, &[]);
    submit(log, uid, 6, next).unwrap();
    synced(log, uid, 7).unwrap();
    let view = log.view(uid).unwrap();
    assert_eq!((view.revision(), view.next_id()), (7, 11));
    assert_eq!(view.sessions().get(2).unwrap().batch, 3);
    assert_eq!(view.sessions().owner(10), Some(2));
    assert_eq!(Vec::from_iter(all_points(&*view).into_keys()), [0, 2, 3, 4]);
}

#[test]
fn a_directory_of_version_4_is_opened() {
    for ended_cleanly in [true, false] {
        let directory = of_version(4);
        let path = directory.path();
        if !ended_cleanly {
            fs::remove_file(path.join("journal-synced")).unwrap();
        }
        for _ in 0..2 {
            let log = open(path);
            assert_eq!(dump(&log), CONTENT);
            let uid = index(&log, "arm").uid;
            let trimmed = LogError::trimmed(uid, 2, 3);
            assert_eq!(log.read(uid, Some(2), usize::MAX), Err(trimmed));
        }
        let log = open(path);
        check_next_batch(&log);
        let (whole, leg) = (dump(&log), CONTENT.find("index leg").unwrap());
        assert!(whole.ends_with(&CONTENT[leg..]), "{whole}");
    }
}

#[test]
fn repair_finds_a_directory_of_version_4_whole() {
    for dry_run in [true, false] {
        let directory = of_version(4);
        let report = repair(directory.path(), dry_run).unwrap();
        assert_eq!((report.damage, report.whole), (None, 2));
        assert_eq!(dump(&open(directory.path())), CONTENT);
    }
}
