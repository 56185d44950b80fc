//! A directory of version 4, with writer sessions, is opened with everything in it.
//!
//! `version-4/` is such a directory as it was left when version 4 was current. In `arm` the operation `first` inserted
//! the points 0 to 2 (revision 1). Session 2 was opened with the ids 3 to 5 (revision 2), and its batch 1 stored
//! point 3 (revision 3). Session 4 was opened with the ids 6 and 7 (revision 4). The operation `second` removed point 1
//! (revision 5), and the records up to revision 3 and the operation `first` were trimmed. Batch 2 of session 2 stored
//! point 0 again, reserved the id 8 and ended session 4 (revision 6). In `leg` session 1 was opened with the ids 0 to 3.
//! An index `gone` was created and deleted.

use std::fs;

use bytes::Bytes;
use wayfold_server::log::{Catalogue, FjallLog, Journal, LogError, PointStore, Session, repair};

use super::{
    all_points,
    disk::{index, of_version, open, with_batch},
    effects, submit, synced,
};

/// Asserts what the index `leg` and the catalogue held.
fn check_leg(log: &FjallLog) {
    assert_eq!((log.lost(), log.failure()), (Vec::new(), None));
    assert_eq!(log.indexes().unwrap().len(), 2);
    let leg = index(log, "leg");
    assert_eq!(leg.uid.to_string(), "7a6221d3-bcc3-4fea-a3e9-0fcb08e3e7d5");
    let view = log.view(leg.uid).unwrap();
    assert_eq!((view.revision(), view.next_id()), (1, 4));
    assert!(all_points(&*view).is_empty());
    let sessions = view.sessions();
    assert_eq!((sessions.len(), sessions.block_count()), (1, 1));
    assert_eq!(sessions.get(1).unwrap().batch, 0);
    assert_eq!([3, 4].map(|id| sessions.owner(id)), [Some(1), None]);
}

/// Asserts what the index `arm` held.
fn check_arm(log: &FjallLog) {
    let arm = index(log, "arm");
    let uid = arm.uid;
    assert_eq!(uid.to_string(), "1b8e818d-9f84-4591-8d83-b9cf142dae38");
    assert_eq!(arm.space, "R1".parse().unwrap());
    let view = log.view(uid).unwrap();
    assert_eq!((view.revision(), view.next_id()), (6, 9));
    let points: Vec<_> = all_points(&*view)
        .into_values()
        .map(|point| {
            (
                point.id,
                point.revision,
                point.state[0],
                point.payload.clone(),
            )
        })
        .collect();
    let expected = [(0, 6), (2, 1), (3, 3)].map(|(id, revision)| {
        let payload = Bytes::from(format!("{id} at {revision}"));
        (id, revision, revision as f64, payload)
    });
    assert_eq!(points, expected);

    let sessions = view.sessions();
    assert_eq!((sessions.len(), sessions.block_count()), (1, 2));
    let session = Session {
        batch: 2,
        fingerprint: [2; 32],
        response: Bytes::from_static(b"batch 2 of 2"),
        used_ms: 1_795_562_545_638,
    };
    assert_eq!(**sessions.get(2).unwrap(), session);
    let owners = [2, 3, 5, 6, 7, 8, 9].map(|id| sessions.owner(id));
    let of_session = Some(2);
    assert_eq!(
        owners,
        [None, of_session, of_session, None, None, of_session, None]
    );

    let operations = log.operations(uid).unwrap();
    let operations: Vec<&str> = operations.iter().map(|it| it.id.as_str()).collect();
    assert_eq!(operations, ["second"]);
    let trimmed = LogError::Trimmed {
        uid,
        after: 2,
        oldest: 3,
    };
    assert_eq!(log.read(uid, Some(2), usize::MAX), Err(trimmed));
    let records = log.read(uid, None, usize::MAX).unwrap();
    let revisions: Vec<u64> = records.iter().map(|record| record.revision()).collect();
    assert_eq!(revisions, [4, 5, 6]);
    assert!(records[1].follows(records[0].position()) && records[2].follows(records[1].position()));
    assert!(records.iter().all(|record| record.is_intact()));
    assert_eq!(records[1].effects().removed(), [1]);
    assert_eq!(records[2].effects().batch().unwrap().ended, [4]);
}

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
            check_arm(&log);
            check_leg(&log);
        }
        let log = open(path);
        check_next_batch(&log);
        check_leg(&log);
    }
}

#[test]
fn repair_finds_a_directory_of_version_4_whole() {
    for dry_run in [true, false] {
        let directory = of_version(4);
        let report = repair(directory.path(), dry_run).unwrap();
        assert_eq!((report.damage, report.whole), (None, 2));
        let log = open(directory.path());
        check_arm(&log);
        check_leg(&log);
    }
}
