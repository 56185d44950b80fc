//! Promises of the log on disk beyond those of the others: its syncs, its state after a crash, its views.

use std::fs;

use futures_util::{FutureExt, StreamExt};
use wayfold_server::log::{
    Catalogue, Durability, FjallLog, Journal, LogError, PointStore, StoreOptions, Uid,
};

use super::{
    all_points,
    copied::copied,
    disk::{append, append_synced, open, open_at, with_batch},
    effects, entry, submit, synced,
};

#[test]
fn one_sync_covers_all_earlier_writes() {
    let directory = tempfile::tempdir().unwrap();
    let log = open(directory.path());
    let indexes = [entry("one"), entry("two")];
    for entry in &indexes {
        log.create(entry.clone()).unwrap();
        for revision in 1..=50 {
            append(&log, entry.uid, revision);
        }
    }
    synced(&log, indexes[1].uid, 50).unwrap();
    // This index's records were written earlier, so the same sync covers them.
    let mut other = log.follow(indexes[0].uid, 49);
    let records = other.next().now_or_never().unwrap().unwrap().unwrap();
    assert_eq!(records.last().unwrap().revision(), 50);
}

/// The store of a server in a cluster, whose journal is in NATS. A killed server has all that it applied, so that it can
/// make up for a journal that has lost records.
#[test]
fn a_copy_hands_each_batch_to_the_operating_system_and_is_synced_later() {
    let directory = tempfile::tempdir().unwrap();
    let options = StoreOptions {
        is_copy: true,
        ..Durability::Fsync.into()
    };
    let log = FjallLog::open(directory.path(), options).unwrap();
    let arm = entry("arm");
    let uid = arm.uid;
    log.create(arm).unwrap();
    for revision in 1..=50 {
        append(&log, uid, revision);
    }
    let copy = copied(directory.path());
    assert_eq!(open(copy.path()).view(uid).unwrap().revision(), 50);
    synced(&log, uid, 50).unwrap();
    append(&log, uid, 51);
    drop(log);
    assert_eq!(open(directory.path()).view(uid).unwrap().revision(), 51);
}

/// An unreadable disk is not reported as damage.
#[test]
fn a_list_of_tables_that_cannot_be_read_is_no_loss_of_data() {
    let directory = tempfile::tempdir().unwrap();
    let log = open(directory.path());
    let arm = entry("arm");
    log.create(arm.clone()).unwrap();
    drop(log);
    let current = directory.path().join("store/keyspaces/0/current");
    let whole = fs::read(&current).unwrap();
    fs::remove_file(&current).unwrap();
    // A link to itself: the one failure that root meets on every disk.
    std::os::unix::fs::symlink(&current, &current).unwrap();
    let log = open(directory.path());
    assert!(
        matches!(log.failure(), Some(LogError::Shut { .. })),
        "{:?}",
        log.failure()
    );
    fs::remove_file(&current).unwrap();
    fs::write(&current, whole).unwrap();
    log.reopen().unwrap();
    assert_eq!(log.indexes().unwrap(), [arm]);
}

#[test]
fn a_closed_log_is_not_reopened() {
    let directory = tempfile::tempdir().unwrap();
    let log = open(directory.path());
    log.close();
    assert_eq!(log.reopen(), Err(LogError::Closed));
    assert_eq!(log.failure(), Some(LogError::Closed));
}

/// Writer sessions and reserved ids stay.
#[test]
fn below_fsync_a_crash_that_may_have_lost_something_makes_new_uids() {
    for (durability, another_boot, kept) in [
        (Durability::Fsync, false, true),
        (Durability::Os, false, cfg!(target_os = "linux")),
        (Durability::Os, true, false),
        (Durability::None, false, false),
    ] {
        let directory = tempfile::tempdir().unwrap();
        let log = open_at(directory.path(), durability);
        let arm = entry("arm");
        log.create(arm.clone()).unwrap();
        let opening = with_batch(effects(1, &[1], &[]), (1, 0), 10..20, &[]);
        submit(&log, arm.uid, 0, opening).unwrap();
        synced(&log, arm.uid, 1).unwrap();
        let before = log.view(arm.uid).unwrap();
        let crashed = copied(directory.path());
        if another_boot {
            fs::write(crashed.path().join("unsynced"), "os another").unwrap();
        }
        let after = open_at(crashed.path(), durability);
        let uids: Vec<Uid> = after.indexes().unwrap().iter().map(|e| e.uid).collect();
        assert_eq!(uids == [arm.uid], kept, "{durability:?}");
        assert!(uids.len() == 1 || durability == Durability::None);
        if durability != Durability::None {
            let view = after.view(uids[0]).unwrap();
            assert_eq!((view.revision(), view.next_id()), (1, 20));
            assert_eq!(view.sessions(), before.sessions());
        }
        // After an orderly stop nothing is missing.
        drop((before, log));
        let after = open_at(directory.path(), durability);
        assert_eq!(after.view(arm.uid).unwrap().revision(), 1);
    }
}

/// The view follows no later revision, whether it was read before that revision or not.
#[test]
fn a_view_stays_at_its_revision_when_its_index_is_written_and_deleted() {
    let directory = tempfile::tempdir().unwrap();
    let log = open(directory.path());
    let (arm, other) = (entry("arm"), entry("other"));
    for entry in [&arm, &other] {
        log.create(entry.clone()).unwrap();
    }
    let mut views = Vec::new();
    for revision in 1..=5 {
        append_synced(&log, arm.uid, revision);
        let view = log.view(arm.uid).unwrap();
        let shared = log.view(arm.uid).unwrap();
        if revision % 2 == 0 {
            assert_eq!(all_points(&*shared).len() as u64, revision);
        }
        views.push(view);
    }
    // This removes a point that every view holds.
    let removed: Vec<u64> = (1..=5).collect();
    submit(&log, arm.uid, 5, effects(6, &[9], &removed)).unwrap();
    views.push(log.view(arm.uid).unwrap());
    append_synced(&log, other.uid, 1);
    log.delete(arm.uid).unwrap();
    for (view, revision) in views.iter().zip(1..) {
        assert_eq!(view.revision(), revision);
        let ids: Vec<u64> = all_points(&**view).into_keys().collect();
        let expected: Vec<u64> = if revision < 6 {
            (1..=revision).collect()
        } else {
            vec![9]
        };
        assert_eq!(ids, expected);
        let point = view.get(ids[0]).unwrap().unwrap();
        assert_eq!(point.modified, if revision < 6 { 1 } else { 6 });
    }
}
