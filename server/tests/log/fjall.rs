//! What the log on disk promises beyond the others: what is left after a crash, and that damage is found and named.

use std::{fs, path::Path, slice};

use bytes::Bytes;
use futures_util::FutureExt;
use wayfold_server::log::{Durability, FjallLog, Log, LogError, Origin, StoredPoint, Uid};

use super::{all_points, effects, entry, kept::copied};

fn open(directory: &Path, durability: Durability) -> FjallLog {
    FjallLog::open(directory, durability).unwrap()
}

fn append(log: &FjallLog, uid: Uid, revision: u64) {
    let appended = log.append(uid, revision - 1, effects(revision, &[revision], &[]));
    assert_eq!(appended.unwrap().revision(), revision);
}

/// Waits on this thread.
fn wait_synced(log: &FjallLog, uid: Uid, revision: u64) {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .build()
        .unwrap();
    runtime.block_on(log.synced(uid, revision)).unwrap();
}

#[test]
fn what_was_synced_survives_a_crash_at_any_moment() {
    let directory = tempfile::tempdir().unwrap();
    let log = open(directory.path(), Durability::Fsync);
    let arm = entry("arm");
    let uid = arm.uid;
    log.create(arm.clone()).unwrap();
    for revision in 1..=20 {
        append(&log, uid, revision);
        wait_synced(&log, uid, revision);
        if revision % 5 > 0 {
            continue;
        }
        let copy = copied(directory.path());
        let after = open(copy.path(), Durability::Fsync);
        assert_eq!(after.indexes().unwrap()[..], *slice::from_ref(&arm));
        let view = after.points(uid).unwrap();
        assert_eq!((view.revision(), view.next_id()), (revision, revision + 1));
        assert_eq!(all_points(&*view), all_points(&*log.points(uid).unwrap()));
        assert_eq!(
            after.tail(uid, None, usize::MAX),
            log.tail(uid, None, usize::MAX)
        );
        append(&after, uid, revision + 1);
    }
}

#[test]
fn one_sync_is_shared_by_all_who_wrote_before_it() {
    let directory = tempfile::tempdir().unwrap();
    let log = open(directory.path(), Durability::Fsync);
    let indexes = [entry("one"), entry("two")];
    for entry in &indexes {
        log.create(entry.clone()).unwrap();
        for revision in 1..=50 {
            append(&log, entry.uid, revision);
        }
    }
    wait_synced(&log, indexes[1].uid, 50);
    // It was written before, so it needs no other.
    let other = log.synced(indexes[0].uid, 50);
    assert_eq!(other.now_or_never(), Some(Ok(50)));
}

/// The newest journal of fjall, and how much of it is written.
fn journal(directory: &Path) -> (std::path::PathBuf, u64) {
    let files = fs::read_dir(directory.join("store")).unwrap();
    let journals = files
        .map(|file| file.unwrap().path())
        .filter(|path| path.extension().is_some_and(|kind| kind == "jnl"));
    let path = journals.max().unwrap();
    let bytes = fs::read(&path).unwrap();
    let used = bytes.iter().rposition(|&byte| byte != 0).unwrap() + 1;
    (path, used as u64)
}

#[test]
fn a_journal_cut_short_of_what_was_synced_is_named() {
    let directory = tempfile::tempdir().unwrap();
    let log = open(directory.path(), Durability::Fsync);
    let (arm, idle) = (entry("arm"), entry("idle"));
    for entry in [&arm, &idle] {
        log.create(entry.clone()).unwrap();
    }
    for revision in 1..=3 {
        append(&log, arm.uid, revision);
    }
    drop(log);
    let (path, used) = journal(directory.path());
    let file = fs::File::options().write(true).open(path).unwrap();
    file.set_len(used - 1).unwrap();

    let lost = LogError::Lost {
        uid: arm.uid,
        first: 3,
        last: 3,
    };
    // It stays so, and the other index is not concerned.
    for _ in 0..2 {
        let log = open(directory.path(), Durability::Fsync);
        assert_eq!(log.tail(arm.uid, None, usize::MAX).unwrap_err(), lost);
        assert_eq!(log.points(arm.uid).err(), Some(lost.clone()));
        let refused = log.append(arm.uid, 2, effects(3, &[1], &[]));
        assert_eq!(refused.unwrap_err(), lost);
        assert_eq!(log.points(idle.uid).unwrap().revision(), 0);
    }
    let log = open(directory.path(), Durability::Fsync);
    log.delete(arm.uid).unwrap();
    assert_eq!(log.indexes().unwrap(), [idle]);
}

/// Whatever happens to one byte of the journal, a start tells of it, or nothing is missing.
#[test]
fn a_flipped_byte_of_the_journal_is_never_a_silent_gap() {
    let directory = tempfile::tempdir().unwrap();
    let log = open(directory.path(), Durability::Fsync);
    let arm = entry("arm");
    log.create(arm.clone()).unwrap();
    for revision in 1..=3 {
        append(&log, arm.uid, revision);
    }
    let whole = all_points(&*log.points(arm.uid).unwrap());
    drop(log);
    let (path, used) = journal(directory.path());
    let name = path.strip_prefix(directory.path()).unwrap();
    let mut told = 0;
    for at in (0..used).step_by(97) {
        let copy = copied(directory.path());
        let mut bytes = fs::read(&path).unwrap();
        bytes[at as usize] ^= 0x10;
        fs::write(copy.path().join(name), bytes).unwrap();
        let log = open(copy.path(), Durability::Fsync);
        let gone = log.gone();
        match log.points(arm.uid) {
            Ok(view) => assert_eq!(all_points(&*view), whole, "byte {at}"),
            Err(LogError::Lost { .. }) => told += 1,
            // The index as a whole, where its creation was cut off, or all there is.
            Err(LogError::UnknownIndex { .. } | LogError::Unopened { .. }) => {
                assert_eq!((&*gone[0].name, gone[0].uid), ("arm", arm.uid), "byte {at}");
                told += 1;
            }
            Err(other) => panic!("byte {at}: {other}"),
        }
    }
    assert!(told > 0);
}

/// The disk is taken away and comes back. What was acknowledged is there, what was not is there whole or not at all.
#[test]
fn a_store_that_failed_is_read_and_is_opened_anew_once_it_can_be() {
    let directory = tempfile::tempdir().unwrap();
    let log = open(directory.path(), Durability::Fsync);
    let arm = entry("arm");
    let uid = arm.uid;
    log.create(arm.clone()).unwrap();
    for revision in 1..=3 {
        append(&log, uid, revision);
        wait_synced(&log, uid, revision);
    }
    let (store, away) = (
        directory.path().join("store"),
        directory.path().join("away"),
    );
    for head in [3, 4, 5] {
        assert_eq!(log.failure(), None);
        let view = log.points(uid).unwrap();
        let before = all_points(&*view);
        fs::rename(&store, &away).unwrap();
        append(&log, uid, head + 1);
        let runtime = tokio::runtime::Builder::new_current_thread()
            .build()
            .unwrap();
        let failed = runtime.block_on(log.synced(uid, head + 1)).unwrap_err();
        assert!(matches!(failed, LogError::Storage { .. }));
        for _ in 0..2 {
            let refused = log.append(uid, head + 1, effects(head + 2, &[99], &[]));
            assert_eq!(refused.unwrap_err(), failed);
            assert_eq!(log.create(entry("other")), Err(failed.clone()));
            assert_eq!(log.delete(uid), Err(failed.clone()));
            // It is not over yet, and so the store stays as it is.
            assert!(matches!(log.reopen(), Err(LogError::Storage { .. })));
            assert_eq!(log.failure(), Some(failed.clone()));
            assert_eq!(all_points(&*view), before);
        }
        fs::rename(&away, &store).unwrap();
        log.reopen().unwrap();
        assert_eq!(view.get(1).unwrap_err(), LogError::Closed);
        let (found, tail) = (
            log.points(uid).unwrap(),
            log.tail(uid, None, usize::MAX).unwrap(),
        );
        // The last one was handed to the system: it happens to be there.
        assert_eq!((found.revision(), tail.len() as u64), (head + 1, head + 1));
        assert_eq!(all_points(&*found).len() as u64, head + 1);
    }
    drop(log);
    let log = open(directory.path(), Durability::Fsync);
    assert_eq!(log.points(uid).unwrap().revision(), 6);
}

#[test]
fn a_store_that_is_missing_is_not_taken_for_an_empty_one() {
    let directory = tempfile::tempdir().unwrap();
    let log = open(directory.path(), Durability::Fsync);
    let arm = entry("arm");
    let uid = arm.uid;
    log.create(arm.clone()).unwrap();
    append(&log, uid, 1);
    wait_synced(&log, uid, 1);
    drop(log);
    let (store, away) = (
        directory.path().join("store"),
        directory.path().join("away"),
    );
    fs::rename(&store, &away).unwrap();
    let log = open(directory.path(), Durability::Fsync);
    let gone = log.gone();
    assert_eq!((&*gone[0].name, gone[0].uid), ("arm", uid));
    assert!(
        gone[0].why.to_string().contains("revisions 1 to 1"),
        "{}",
        gone[0].why
    );
    for error in [
        log.points(uid).err().unwrap(),
        log.create(entry("other")).unwrap_err(),
        log.failure().unwrap(),
    ] {
        assert!(matches!(error, LogError::Unopened { .. }));
    }
    assert!(log.reopen().is_err());
    fs::rename(&away, &store).unwrap();
    log.reopen().unwrap();
    assert_eq!(log.points(uid).unwrap().revision(), 1);
    assert_eq!(log.gone(), []);
}

/// An index of which the creation was synced and then cut off is named, keeps its number, and can be deleted.
#[test]
fn an_index_of_which_only_the_mark_is_left_is_named_until_it_is_deleted() {
    let directory = tempfile::tempdir().unwrap();
    let log = open(directory.path(), Durability::Fsync);
    let arm = entry("arm");
    log.create(arm.clone()).unwrap();
    drop(log);
    let (path, _) = journal(directory.path());
    fs::File::options()
        .write(true)
        .open(path)
        .unwrap()
        .set_len(0)
        .unwrap();
    for _ in 0..2 {
        let log = open(directory.path(), Durability::Fsync);
        assert_eq!(log.indexes().unwrap(), []);
        let gone = log.gone();
        assert_eq!(
            (gone.len(), &*gone[0].name, gone[0].uid),
            (1, "arm", arm.uid)
        );
    }
    let log = open(directory.path(), Durability::Fsync);
    log.delete(arm.uid).unwrap();
    assert_eq!(log.gone(), []);
    let new = entry("arm");
    log.create(new.clone()).unwrap();
    append(&log, new.uid, 1);
    wait_synced(&log, new.uid, 1);
    drop(log);
    let log = open(directory.path(), Durability::Fsync);
    assert_eq!((log.indexes().unwrap(), log.gone()), (vec![new], vec![]));
}

/// A restore that was acknowledged, and of which the journal then lost some, is not taken for one that was given up.
#[test]
fn a_restored_index_that_is_cut_off_is_named() {
    let directory = tempfile::tempdir().unwrap();
    let log = open(directory.path(), Durability::Fsync);
    let arm = entry("arm");
    log.create(arm.clone()).unwrap();
    let (_, before) = journal(directory.path());
    let copy = entry("copy");
    let origin = Origin {
        revision: 7,
        next_id: 50,
        digest: [3; 32],
    };
    let mut restoring = log.restore(copy.clone(), origin).unwrap();
    let point = |id| StoredPoint {
        id,
        revision: 1,
        modified: 1,
        tag: 0,
        state: Box::new([0.5]),
        payload: Bytes::new(),
    };
    for ids in [0..20, 20..40] {
        restoring.add(&ids.map(point).collect::<Vec<_>>()).unwrap();
    }
    restoring.finish().unwrap();
    // Given up: it leaves nothing, also no mark.
    let mut given_up = log.restore(entry("given-up"), origin).unwrap();
    given_up.add(&[point(1)]).unwrap();
    let (path, used) = journal(directory.path());
    let crashed = copied(directory.path());
    drop(given_up);
    drop(log);
    let name = path.strip_prefix(directory.path()).unwrap();
    let log = open(crashed.path(), Durability::Fsync);
    assert_eq!(log.points(copy.uid).unwrap().revision(), 7);
    assert_eq!((log.indexes().unwrap().len(), log.gone()), (2, vec![]));
    drop(log);
    for length in [before, (2 * before + used) / 3, used - 400] {
        let damaged = copied(directory.path());
        let file = fs::File::options()
            .write(true)
            .open(damaged.path().join(name));
        file.unwrap().set_len(length).unwrap();
        for _ in 0..2 {
            let log = open(damaged.path(), Durability::Fsync);
            assert_eq!(
                log.indexes().unwrap(),
                slice::from_ref(&arm),
                "{length} of {used}"
            );
            let gone = log.gone();
            assert_eq!(
                (gone.len(), &*gone[0].name, gone[0].uid),
                (1, "copy", copy.uid)
            );
            assert_eq!(
                gone[0].why,
                LogError::Lost {
                    uid: copy.uid,
                    first: 1,
                    last: 7
                }
            );
        }
        let log = open(damaged.path(), Durability::Fsync);
        log.delete(copy.uid).unwrap();
        drop(log);
        let log = open(damaged.path(), Durability::Fsync);
        assert_eq!(
            (log.indexes().unwrap(), log.gone()),
            (vec![arm.clone()], vec![])
        );
    }
}

/// However much of it is back after the journal was cut short.
#[test]
fn an_index_that_was_deleted_does_not_come_back() {
    let directory = tempfile::tempdir().unwrap();
    let log = open(directory.path(), Durability::Fsync);
    let (arm, leg) = (entry("arm"), entry("leg"));
    log.create(arm.clone()).unwrap();
    log.create(leg.clone()).unwrap();
    let (_, before) = journal(directory.path());
    append(&log, leg.uid, 1);
    wait_synced(&log, leg.uid, 1);
    log.delete(leg.uid).unwrap();
    let (path, used) = journal(directory.path());
    drop(log);
    let name = path.strip_prefix(directory.path()).unwrap();
    for length in (before..used).step_by(37) {
        let damaged = copied(directory.path());
        let file = fs::File::options()
            .write(true)
            .open(damaged.path().join(name));
        file.unwrap().set_len(length).unwrap();
        for _ in 0..2 {
            let log = open(damaged.path(), Durability::Fsync);
            assert_eq!(
                log.indexes().unwrap(),
                slice::from_ref(&arm),
                "{length} of {used}"
            );
            assert_eq!(log.gone(), []);
        }
        // Its number is not used again.
        let log = open(damaged.path(), Durability::Fsync);
        let new = entry("leg");
        log.create(new.clone()).unwrap();
        append(&log, new.uid, 1);
        wait_synced(&log, new.uid, 1);
        drop(log);
        let log = open(damaged.path(), Durability::Fsync);
        assert_eq!(log.points(new.uid).unwrap().revision(), 1);
    }
}

/// What a disk does not let be read is not damaged.
#[test]
fn a_list_of_tables_that_cannot_be_read_is_no_loss_of_data() {
    let directory = tempfile::tempdir().unwrap();
    let log = open(directory.path(), Durability::Fsync);
    let arm = entry("arm");
    log.create(arm.clone()).unwrap();
    drop(log);
    let current = directory.path().join("store/keyspaces/0/current");
    let whole = fs::read(&current).unwrap();
    fs::remove_file(&current).unwrap();
    fs::create_dir(&current).unwrap();
    let log = open(directory.path(), Durability::Fsync);
    assert!(
        matches!(log.failure(), Some(LogError::Shut { .. })),
        "{:?}",
        log.failure()
    );
    fs::remove_dir(&current).unwrap();
    fs::write(&current, whole).unwrap();
    log.reopen().unwrap();
    assert_eq!(log.indexes().unwrap(), [arm]);
}

#[test]
fn an_index_is_deleted_for_good() {
    let directory = tempfile::tempdir().unwrap();
    let log = open(directory.path(), Durability::Fsync);
    let (first, second) = (entry("arm"), entry("arm"));
    log.create(first.clone()).unwrap();
    append(&log, first.uid, 1);
    let view = log.points(first.uid).unwrap();
    log.delete(first.uid).unwrap();
    log.create(second.clone()).unwrap();
    assert_eq!(view.get(1).unwrap().unwrap().id, 1);
    let crashed = copied(directory.path());
    drop((view, log));
    for directory in [crashed.path(), directory.path()] {
        let after = open(directory, Durability::Fsync);
        assert_eq!(after.indexes().unwrap()[..], *slice::from_ref(&second));
        assert_eq!(after.points(second.uid).unwrap().revision(), 0);
    }
}

#[test]
fn below_fsync_a_crash_that_may_have_lost_something_makes_new_uids() {
    for (durability, another_boot, kept) in [
        (Durability::Fsync, false, true),
        (Durability::Os, false, cfg!(target_os = "linux")),
        (Durability::Os, true, false),
        (Durability::None, false, false),
    ] {
        let directory = tempfile::tempdir().unwrap();
        let log = open(directory.path(), durability);
        let arm = entry("arm");
        log.create(arm.clone()).unwrap();
        append(&log, arm.uid, 1);
        wait_synced(&log, arm.uid, 1);
        let crashed = copied(directory.path());
        if another_boot {
            fs::write(crashed.path().join("unsynced"), "os another").unwrap();
        }
        let after = open(crashed.path(), durability);
        let uids: Vec<Uid> = after.indexes().unwrap().iter().map(|e| e.uid).collect();
        assert_eq!(uids == [arm.uid], kept, "{durability:?}");
        assert!(uids.len() == 1 || durability == Durability::None);
        if durability != Durability::None {
            assert_eq!(after.points(uids[0]).unwrap().revision(), 1);
        }
        // After an orderly stop everything is there.
        drop(log);
        let after = open(directory.path(), durability);
        assert_eq!(after.points(arm.uid).unwrap().revision(), 1);
    }
}
