//! An index is replaced by a copy at a later revision, under its uid.

use std::{collections::BTreeMap, fs, slice, sync::Arc};

use bytes::Bytes;
use wayfold_server::log::{
    Catalogue, Durability, Effects, Entry, LogError, Operation, Origin, PointStore, Record,
    RecordPosition, Session, Sessions, StoredPoint,
};

use crate::{
    Engine, all_points,
    copied::copied,
    disk::{JournalFile, append_synced, open, open_at},
    effects, entry, submit,
    test_log::TestLog,
};

/// The copy: its revision is far beyond that of the index.
const ORIGIN: Origin = Origin {
    revision: 90,
    next_id: 500,
    digest: [9; 32],
};

fn point(id: u64) -> StoredPoint {
    StoredPoint {
        id,
        revision: 80,
        modified: 85,
        tag: 3,
        state: Box::new([0.25]),
        payload: Bytes::from_static(b"peer"),
    }
}

fn operations() -> Vec<Arc<Operation>> {
    let operation = |id: &str| {
        Arc::new(Operation {
            id: id.into(),
            fingerprint: [5; 32],
            response: Bytes::from_static(b"done"),
        })
    };
    ["first", "second"].map(operation).into()
}

fn sessions() -> Sessions {
    let mut sessions = Sessions::default();
    let session = Session {
        batch: 4,
        fingerprint: [1; 32],
        response: Bytes::from_static(b"batch"),
        used_ms: 7,
    };
    sessions.insert(11, session);
    sessions
}

/// Replaces an index by the points 100 to 139.
fn replace(log: &(impl Engine + ?Sized), entry: &Entry, origin: Origin) -> Result<(), LogError> {
    let mut copy = log.restore(entry.clone(), origin, true)?;
    for ids in [100..120, 120..140] {
        let before = log.view(entry.uid).unwrap().revision();
        copy.add(&ids.map(point).collect::<Vec<_>>())?;
        assert_eq!(log.view(entry.uid).unwrap().revision(), before);
    }
    copy.finish(sessions(), operations())
}

/// Asserts that the index is the copy.
fn check_replaced(log: &(impl Engine + ?Sized), entry: &Entry) {
    let view = log.view(entry.uid).unwrap();
    let position = RecordPosition {
        revision: ORIGIN.revision,
        digest: ORIGIN.digest,
    };
    assert_eq!(
        (view.position(), view.next_id()),
        (position, ORIGIN.next_id)
    );
    let points = all_points(&*view);
    assert_eq!(points.len(), 40);
    assert!(points.iter().all(|(id, found)| **found == point(*id)));
    let session = view.sessions().get(11).unwrap();
    assert_eq!((session.batch, &*session.response), (4, &b"batch"[..]));
    assert_eq!(log.operations(entry.uid).unwrap(), operations());
    assert_eq!(log.indexes().unwrap(), slice::from_ref(entry));
    assert_eq!(log.lost(), []);
}

fn with_operation(revision: u64, id: &str) -> Effects {
    let mut effects = effects(revision, &[7], &[100]);
    effects.set_operation(Some(Arc::new(Operation {
        id: id.into(),
        fingerprint: [6; 32],
        response: Bytes::new(),
    })));
    effects
}

fn three_kinds() -> [TestLog; 3] {
    [TestLog::in_memory(), TestLog::on_disk(), TestLog::faulty(1)]
}

#[test]
fn a_replaced_index_is_the_copy_and_goes_on_from_it() {
    for mut kept in three_kinds() {
        let (arm, log) = (entry("arm"), kept.log());
        log.create(arm.clone()).unwrap();
        for revision in 1..=3 {
            submit(log, arm.uid, revision - 1, with_operation(revision, "old")).unwrap();
        }
        let held = log.view(arm.uid).unwrap();
        let points = all_points(&*held);
        replace(log, &arm, ORIGIN).unwrap();
        check_replaced(log, &arm);
        assert_eq!(all_points(&*held), points, "held views stay");
        drop(held);
        kept.reopen();
        let log = kept.log();
        check_replaced(log, &arm);
        // Only the record after that of the copy follows.
        let position = log.view(arm.uid).unwrap().position();
        let foreign = Record::new(91, [7; 32], 0, Effects::new(1));
        assert!(log.apply(arm.uid, &[Arc::new(foreign)]).is_err());
        let next = Arc::new(Record::after(position, with_operation(91, "new")));
        let view = log.apply(arm.uid, slice::from_ref(&next)).unwrap();
        assert_eq!(view.position(), next.position());
        let ids: Vec<_> = log.operations(arm.uid).unwrap();
        let ids: Vec<_> = ids.iter().map(|operation| &*operation.id).collect();
        assert_eq!(ids, ["first", "second", "new"]);
        assert_eq!(log.read(arm.uid, Some(90), usize::MAX).unwrap(), [next]);
        assert!(matches!(
            log.read(arm.uid, Some(3), usize::MAX),
            Err(LogError::Trimmed { oldest: 90, .. })
        ));
        drop(view);
        kept.reopen();
        assert_eq!(kept.log().view(arm.uid).unwrap().revision(), 91);
    }
}

/// A part of its points could not be read, and nothing was written meanwhile.
#[test]
fn a_copy_of_the_same_record_takes_the_place_of_an_index() {
    for mut kept in three_kinds() {
        let (arm, log) = (entry("arm"), kept.log());
        log.create(arm.clone()).unwrap();
        submit(log, arm.uid, 0, effects(1, &[1], &[])).unwrap();
        let position = log.view(arm.uid).unwrap().position();
        let origin = Origin {
            revision: position.revision,
            digest: position.digest,
            ..ORIGIN
        };
        let mut copy = log.restore(arm.clone(), origin, true).unwrap();
        let whole = StoredPoint {
            revision: 1,
            modified: 1,
            ..point(2)
        };
        copy.add(slice::from_ref(&whole)).unwrap();
        copy.finish(Sessions::default(), vec![]).unwrap();
        kept.reopen();
        let view = kept.log().view(arm.uid).unwrap();
        assert_eq!(view.position(), position);
        let expected = BTreeMap::from([(2, Arc::new(whole))]);
        assert_eq!(all_points(&*view), expected);
    }
}

#[test]
fn an_index_is_never_taken_back_or_brought_back() {
    for kept in three_kinds() {
        let (arm, log) = (entry("arm"), kept.log());
        let unknown = LogError::UnknownIndex { uid: arm.uid };
        assert_eq!(replace(log, &arm, ORIGIN), Err(unknown.clone()));
        log.create(arm.clone()).unwrap();
        submit(log, arm.uid, 0, effects(1, &[1], &[])).unwrap();
        for revision in [0, 1] {
            let origin = Origin { revision, ..ORIGIN };
            let copy = log.restore(arm.clone(), origin, true).unwrap();
            let fenced = LogError::fenced(arm.uid, revision, 1);
            assert_eq!(copy.finish(sessions(), vec![]), Err(fenced));
        }
        // The refused copies have changed nothing.
        submit(log, arm.uid, 1, effects(2, &[2], &[])).unwrap();
        assert_eq!(all_points(&*log.view(arm.uid).unwrap()).len(), 2);
        // The index is deleted while it is copied.
        let copy = log.restore(arm.clone(), ORIGIN, true).unwrap();
        log.delete(arm.uid).unwrap();
        assert_eq!(copy.finish(sessions(), vec![]), Err(unknown));
        assert_eq!(log.indexes().unwrap(), []);
    }
}

#[test]
fn a_copy_with_more_operations_than_revisions_is_refused() {
    for kept in [TestLog::in_memory(), TestLog::on_disk()] {
        let (arm, log) = (entry("arm"), kept.log());
        log.create(arm.clone()).unwrap();
        let origin = Origin {
            revision: 1,
            ..ORIGIN
        };
        let copy = log.restore(arm.clone(), origin, true).unwrap();
        let refused = copy.finish(sessions(), operations()).unwrap_err();
        let why = "more operations than revisions";
        assert!(refused.to_string().contains(why), "{refused}");
        submit(log, arm.uid, 0, effects(1, &[1], &[])).unwrap();
    }
}

#[test]
fn a_crash_leaves_the_index_or_its_copy() {
    for durability in [Durability::Fsync, Durability::Os] {
        let directory = tempfile::tempdir().unwrap();
        let log = open_at(directory.path(), durability);
        let arm = entry("arm");
        log.create(arm.clone()).unwrap();
        append_synced(&log, arm.uid, 1);
        let mut copy = log.restore(arm.clone(), ORIGIN, true).unwrap();
        copy.add(&(100..140).map(point).collect::<Vec<_>>())
            .unwrap();
        let before = copied(directory.path());
        copy.finish(sessions(), operations()).unwrap();
        let after = copied(directory.path());
        drop(log);
        let log = open_at(before.path(), durability);
        assert_eq!(log.indexes().unwrap(), slice::from_ref(&arm));
        assert_eq!(log.view(arm.uid).unwrap().revision(), 1);
        drop(log);
        check_replaced(&open_at(after.path(), durability), &arm);
    }
}

/// The machine loses power while the last batch of a copy is written: the journal ends within the batch, and the marks are
/// those before it.
#[test]
fn a_journal_that_ends_in_the_last_batch_leaves_one_of_both() {
    let directory = tempfile::tempdir().unwrap();
    let log = open(directory.path());
    let arm = entry("arm");
    log.create(arm.clone()).unwrap();
    append_synced(&log, arm.uid, 1);
    let mut copy = log.restore(arm.clone(), ORIGIN, true).unwrap();
    copy.add(&(100..140).map(point).collect::<Vec<_>>())
        .unwrap();
    let marks = fs::read(directory.path().join("marks")).unwrap();
    let before = JournalFile::of(directory.path()).used;
    copy.finish(sessions(), operations()).unwrap();
    let journal = JournalFile::of(directory.path());
    assert!(journal.used > before);
    let mut revisions = Vec::new();
    let lengths = (before..journal.used).step_by(41);
    for length in lengths.chain([journal.used]) {
        let cut = journal.cut(length);
        fs::write(cut.path().join("marks"), &marks).unwrap();
        let log = open(cut.path());
        match log.view(arm.uid).unwrap().revision() {
            1 => assert_eq!(log.indexes().unwrap(), slice::from_ref(&arm)),
            _ => check_replaced(&log, &arm),
        }
        assert_eq!(log.lost(), []);
        revisions.push(log.view(arm.uid).unwrap().revision());
    }
    assert_eq!((revisions.first(), revisions.last()), (Some(&1), Some(&90)));
}
