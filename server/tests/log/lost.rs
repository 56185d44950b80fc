//! The log on disk names its lost indices, and a deleted index stays deleted.

use std::{fs, slice};

use bytes::Bytes;
use tempfile::TempDir;
use wayfold_server::log::{
    Catalogue, Durability, Entry, Journal, LogError, Origin, PointStore, Sessions, StoredPoint,
    repair,
};

use super::{
    all_points,
    copied::copied,
    disk::{JournalFile, Part, append, append_synced, only_gone, open, open_at},
    effects, entry, submit,
    tables::{created, grow, payload},
};

/// A log whose journal has lost its end, with the revisions 1 to 3 of `arm` and an idle index; and the error of `arm`.
fn without_its_end(durability: Durability) -> (TempDir, [Entry; 2], LogError) {
    let directory = tempfile::tempdir().unwrap();
    let log = open_at(directory.path(), durability);
    let (arm, idle) = (entry("arm"), entry("idle"));
    for entry in [&arm, &idle] {
        log.create(entry.clone()).unwrap();
    }
    for revision in 1..=3 {
        append(&log, arm.uid, revision);
    }
    drop(log);
    let journal = JournalFile::of(directory.path());
    let damaged = journal.cut(journal.used - 1);
    let lost = LogError::Lost {
        uid: arm.uid,
        first: 3,
        last: 3,
    };
    (damaged, [arm, idle], lost)
}

#[test]
fn a_journal_without_its_synced_end_is_named() {
    let (damaged, [arm, idle], lost) = without_its_end(Durability::Fsync);
    // The index stays lost, and the other index is unaffected.
    for _ in 0..2 {
        let log = open(damaged.path());
        assert_eq!(log.read(arm.uid, None, usize::MAX).unwrap_err(), lost);
        assert_eq!(log.view(arm.uid).err(), Some(lost.clone()));
        let refused = submit(&log, arm.uid, 2, effects(3, &[1], &[]));
        assert_eq!(refused.unwrap_err(), lost);
        assert_eq!(log.view(idle.uid).unwrap().revision(), 0);
    }
    let log = open(damaged.path());
    log.delete(arm.uid).unwrap();
    assert_eq!(log.indexes().unwrap(), [idle]);
}

/// The disk lost a page of the journal after its revision was synced. fjall cuts the journal there, or the log does.
#[test]
fn a_synced_revision_whose_sectors_are_lost_is_named() {
    const PAGE: usize = 4096;
    let directory = tempfile::tempdir().unwrap();
    let log = open(directory.path());
    let (arm, idle) = (created(&log, "arm"), created(&log, "idle"));
    grow(&log, arm.uid, payload(1, 64)).unwrap();
    drop(log);
    let before = JournalFile::of(directory.path()).used as usize;
    let log = open(directory.path());
    grow(&log, arm.uid, payload(2, 5 * PAGE)).unwrap();
    drop(log);
    let journal = JournalFile::of(directory.path());
    let lost = LogError::Lost {
        uid: arm.uid,
        first: 2,
        last: 2,
    };
    let mut refused = 0;
    let used = journal.used as usize;
    for page in (before.next_multiple_of(PAGE)..used).step_by(PAGE) {
        println!("{page} of {used}");
        let damaged = journal.cut(journal.used);
        let path = damaged.path().join(&journal.name);
        let mut bytes = fs::read(&path).unwrap();
        bytes[page..used.min(page + PAGE)].fill(0);
        fs::write(&path, &bytes).unwrap();
        if repair(damaged.path(), true).is_err() {
            assert!(fs::read(&path).unwrap() == bytes, "a dry run cuts nothing");
            refused += 1;
        }
        for _ in 0..2 {
            let log = open(damaged.path());
            assert_eq!(log.view(arm.uid).err(), Some(lost.clone()));
            assert_eq!(log.view(idle.uid).unwrap().revision(), 0);
        }
        let report = repair(damaged.path(), false).unwrap();
        assert_eq!(report.beyond_repair.len(), 1, "{report:?}");
    }
    assert!(refused >= 8, "{refused} pages are inside a value");
}

/// The system was restarted under a server without fsync, and the journal has lost more than such a server may lose.
#[test]
fn an_index_that_lost_revisions_stays_lost_after_an_unclean_shutdown() {
    let (damaged, [arm, idle], lost) = without_its_end(Durability::Os);
    fs::write(damaged.path().join("unsynced"), "os another").unwrap();
    for _ in 0..2 {
        let log = open_at(damaged.path(), Durability::Os);
        assert_eq!(log.view(arm.uid).err(), Some(lost.clone()));
        assert!(log.view(idle.uid).is_err(), "it has a new uid");
    }
}

/// fjall recreates a missing part over the remaining files.
#[test]
fn any_missing_part_of_a_store_is_named_and_nothing_else_is_touched() {
    let directory = tempfile::tempdir().unwrap();
    let log = open(directory.path());
    let arm = entry("arm");
    log.create(arm.clone()).unwrap();
    append_synced(&log, arm.uid, 1);
    let whole = all_points(&*log.view(arm.uid).unwrap());
    drop(log);
    let journal = JournalFile::of(directory.path()).name;
    for (part, text) in [
        ("store", "there is no"),
        ("store/keyspaces", " is missing"),
        ("store/keyspaces/0", " is missing"),
        ("store/keyspaces/1", " is missing"),
        (journal.to_str().unwrap(), " is missing"),
    ] {
        println!("{part}");
        let part_of = Part::of(directory.path(), part);
        part_of.take_away();
        let log = open(directory.path());
        for _ in 0..2 {
            let why = only_gone(&log, &arm).to_string();
            assert!(
                why.contains(text) && why.contains("revisions 1 to 1"),
                "{why}"
            );
            for error in [
                log.view(arm.uid).err().unwrap(),
                log.create(entry("other")).unwrap_err(),
                log.failure().unwrap(),
            ] {
                assert!(matches!(error, LogError::Unopened { .. }), "{error}");
            }
            assert!(log.reopen().is_err());
        }
        part_of.bring_back();
        log.reopen().unwrap();
        assert_eq!(all_points(&*log.view(arm.uid).unwrap()), whole);
        assert_eq!(log.lost(), []);
    }
}

/// fjall itself would abort the process.
#[test]
fn foreign_files_in_a_store_are_named() {
    let directory = tempfile::tempdir().unwrap();
    let log = open(directory.path());
    let arm = entry("arm");
    log.create(arm.clone()).unwrap();
    drop(log);
    let strange = directory.path().join("store/keyspaces/abc");
    std::fs::create_dir(&strange).unwrap();
    let log = open(directory.path());
    let why = only_gone(&log, &arm).to_string();
    assert!(why.contains("keyspaces/abc is not its"), "{why}");
    std::fs::remove_dir(strange).unwrap();
    log.reopen().unwrap();
    assert_eq!(log.view(arm.uid).unwrap().revision(), 0);
}

/// An index whose creation was synced and then cut off is named, keeps its number, and can be deleted.
#[test]
fn an_index_of_which_only_the_mark_is_left_is_named_until_it_is_deleted() {
    let directory = tempfile::tempdir().unwrap();
    let log = open(directory.path());
    let arm = entry("arm");
    log.create(arm.clone()).unwrap();
    drop(log);
    let damaged = JournalFile::of(directory.path()).cut(0);
    for _ in 0..2 {
        let log = open(damaged.path());
        assert_eq!(log.indexes().unwrap(), []);
        only_gone(&log, &arm);
    }
    let log = open(damaged.path());
    log.delete(arm.uid).unwrap();
    assert_eq!(log.lost(), []);
    let new = entry("arm");
    log.create(new.clone()).unwrap();
    append_synced(&log, new.uid, 1);
    drop(log);
    let log = open(damaged.path());
    assert_eq!((log.indexes().unwrap(), log.lost()), (vec![new], vec![]));
}

/// A restore was acknowledged, and the journal then lost part of it. The log does not take it for a restore that was
/// given up.
#[test]
fn a_restored_index_that_is_cut_off_is_named() {
    let directory = tempfile::tempdir().unwrap();
    let log = open(directory.path());
    let arm = entry("arm");
    log.create(arm.clone()).unwrap();
    let before = JournalFile::of(directory.path()).used;
    let copy = entry("copy");
    let origin = Origin {
        revision: 7,
        next_id: 50,
        digest: [3; 32],
    };
    let mut restoring = log.restore(copy.clone(), origin, false).unwrap();
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
    restoring.finish(Sessions::default(), vec![]).unwrap();
    // An abandoned restore leaves nothing behind, not even a mark.
    let mut given_up = log.restore(entry("given-up"), origin, false).unwrap();
    given_up.add(&[point(1)]).unwrap();
    let journal = JournalFile::of(directory.path());
    let crashed = copied(directory.path());
    drop(given_up);
    drop(log);
    let log = open(crashed.path());
    assert_eq!(log.view(copy.uid).unwrap().revision(), 7);
    assert_eq!((log.indexes().unwrap().len(), log.lost()), (2, vec![]));
    drop(log);
    let lost = LogError::Lost {
        uid: copy.uid,
        first: 1,
        last: 7,
    };
    let used = journal.used;
    for length in [before, (2 * before + used) / 3, used - 400] {
        println!("{length} of {used}");
        let damaged = journal.cut(length);
        for _ in 0..2 {
            let log = open(damaged.path());
            assert_eq!(log.indexes().unwrap(), slice::from_ref(&arm));
            assert_eq!(only_gone(&log, &copy), lost);
        }
        let log = open(damaged.path());
        log.delete(copy.uid).unwrap();
        drop(log);
        let log = open(damaged.path());
        assert_eq!(log.indexes().unwrap(), slice::from_ref(&arm));
        assert_eq!(log.lost(), []);
    }
}

/// The index stays deleted, however much of it the cut journal brings back.
#[test]
fn an_index_that_was_deleted_does_not_come_back() {
    let directory = tempfile::tempdir().unwrap();
    let log = open(directory.path());
    let (arm, leg) = (entry("arm"), entry("leg"));
    log.create(arm.clone()).unwrap();
    log.create(leg.clone()).unwrap();
    let before = JournalFile::of(directory.path()).used;
    append_synced(&log, leg.uid, 1);
    log.delete(leg.uid).unwrap();
    let journal = JournalFile::of(directory.path());
    drop(log);
    for length in (before..journal.used).step_by(37) {
        println!("{length} of {}", journal.used);
        let damaged = journal.cut(length);
        for _ in 0..2 {
            let log = open(damaged.path());
            assert_eq!(log.indexes().unwrap(), slice::from_ref(&arm));
            assert_eq!(log.lost(), []);
        }
        // The lost index's number is never reused.
        let log = open(damaged.path());
        let new = entry("leg");
        log.create(new.clone()).unwrap();
        append_synced(&log, new.uid, 1);
        drop(log);
        let log = open(damaged.path());
        assert_eq!(log.view(new.uid).unwrap().revision(), 1);
    }
}

/// A directory with many deleted indices, of which a cut journal brings one back.
#[test]
fn the_marks_of_deleted_indices_do_not_stay() {
    let directory = tempfile::tempdir().unwrap();
    let marks = || fs::metadata(directory.path().join("marks")).unwrap().len();
    let log = open(directory.path());
    let arm = entry("arm");
    log.create(arm.clone()).unwrap();
    append_synced(&log, arm.uid, 1);
    let before = marks();
    let others: Vec<_> = (0..100).map(|_| entry("leg")).collect();
    for other in &others {
        log.create(other.clone()).unwrap();
        log.delete(other.uid).unwrap();
    }
    let journal = JournalFile::of(directory.path());
    let grown = marks();
    assert!(grown > 100 * before);
    drop(log);
    let damaged = journal.cut(journal.used / 2);
    drop(open(directory.path()));
    assert!(marks() < grown / 10, "{} of {grown}", marks());
    let rewritten = fs::read(directory.path().join("marks")).unwrap();
    fs::write(damaged.path().join("marks"), rewritten).unwrap();
    for _ in 0..2 {
        let log = open(damaged.path());
        assert_eq!(log.indexes().unwrap(), slice::from_ref(&arm));
        assert_eq!(log.lost(), []);
        assert_eq!(log.view(arm.uid).unwrap().revision(), 1);
        let new = entry("leg");
        log.create(new.clone()).unwrap();
        append_synced(&log, new.uid, 1);
        log.delete(new.uid).unwrap();
    }
}
