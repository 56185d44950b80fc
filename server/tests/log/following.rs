//! `follow` yields each record once and in order, whatever is trimmed meanwhile, to the loop that applies it.

use std::{sync::Arc, thread};

use wayfold_server::log::{LogError, Record, Uid};

use crate::{Engine, accepted, effects, entry, next, retention, test_log::TestLog};

const RECORDS: u64 = 60;

/// Submits records up to this revision without applying them, and asks for a trim of everything after each.
fn submit_and_trim(log: &dyn Engine, uid: Uid, last: u64) {
    let mut position = log.view(uid).unwrap().position();
    for revision in position.revision + 1..=last {
        let record = Record::after(position, effects(revision, &[revision], &[]));
        position = record.position();
        accepted(log.submit(uid, Arc::new(record)).unwrap());
        log.trim(uid, &retention(0)).unwrap();
    }
}

/// Takes what the stream yields up to the revision `last`, applies it and trims everything that may be trimmed.
fn apply_and_trim(log: &dyn Engine, uid: Uid, after: u64, last: u64) {
    let mut records = log.follow(uid, after);
    let mut position = None;
    let mut revision = after;
    while revision < last {
        let batch = next(&mut records).unwrap();
        for record in &batch {
            assert_eq!(record.revision(), revision + 1);
            assert!(position.is_none_or(|position| record.follows(position)));
            position = Some(record.position());
            revision = record.revision();
        }
        let view = log.apply(uid, &batch).unwrap();
        assert_eq!(Some(view.position()), position);
        assert_eq!(view.get(revision).unwrap().unwrap().modified, revision);
        log.trim(uid, &retention(0)).unwrap();
    }
}

#[test]
fn a_trim_takes_no_record_that_is_not_applied() {
    for kept in TestLog::of_every_kind() {
        let (log, entry) = (kept.log(), entry("arm"));
        let uid = entry.uid;
        log.create(entry).unwrap();
        for submitted in [3, 4, 9] {
            let applied = log.view(uid).unwrap().revision();
            submit_and_trim(log, uid, submitted);
            apply_and_trim(log, uid, applied, submitted);
            let held = log.read(uid, None, usize::MAX).unwrap();
            let held: Vec<u64> = held.iter().map(|record| record.revision()).collect();
            assert_eq!(held, [submitted]);
        }
    }
}

#[test]
fn a_stream_goes_on_beside_trims() {
    for kept in TestLog::of_every_kind() {
        let (log, entry) = (kept.log(), entry("arm"));
        let uid = entry.uid;
        log.create(entry).unwrap();
        thread::scope(|scope| {
            scope.spawn(|| apply_and_trim(log, uid, 0, RECORDS));
            submit_and_trim(log, uid, RECORDS);
        });
        assert_eq!(log.view(uid).unwrap().revision(), RECORDS);
    }
}

/// A follower other than the loop may read after a trim; it gets the error `Trimmed` then.
#[test]
fn a_stream_from_before_the_trim_fails() {
    for kept in TestLog::of_every_kind() {
        let (log, entry) = (kept.log(), entry("arm"));
        let uid = entry.uid;
        log.create(entry).unwrap();
        submit_and_trim(log, uid, 3);
        apply_and_trim(log, uid, 0, 3);
        let trimmed = LogError::trimmed(uid, 1, 2);
        assert_eq!(next(&mut log.follow(uid, 1)), Err(trimmed));
    }
}
