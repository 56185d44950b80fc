//! The promises of every store of the mutation log; each store must pass the same tests.

#![expect(
    clippy::unwrap_used,
    reason = "a test that cannot go on has failed; clippy spares only what is marked as a test itself"
)]

mod claimed_in_nats;
mod copied;
mod disk;
mod entry_lost_in_nats;
#[expect(dead_code, reason = "only the suite of the service holds up reads")]
mod fault;
mod fjall;
mod flips;
mod following;
mod forgotten;
mod journal_end;
mod large_in_nats;
mod lost;
mod model;
mod nats;
mod pin;
mod rebuilt;
mod remote;
mod renumbered_in_nats;
mod replaced;
mod replaced_in_nats;
mod restored_in_nats;
mod shared_files;
mod suite;
mod swept;
mod tables;
mod test_log;
mod version_3;
mod version_4;

use std::{collections::BTreeMap, sync::Arc, time::SystemTime};

use bytes::Bytes;
use futures_util::StreamExt;
use proptest::prelude::*;
use wayfold_index::PointRef;
use wayfold_proto::v1::PayloadEncoding;
use wayfold_server::log::{
    Catalogue, Effects, Entry, LogError, Outcome, PointStore, Receipt, Record, RecordPosition,
    RecordStream, Retention, StoredPoint, Uid, View,
};

use test_log::TestLog;

/// A log whose three parts are one store.
trait Engine: PointStore + Catalogue {}

impl<Log: PointStore + Catalogue> Engine for Log {}

/// Submits a record after the revision `expected`.
fn submit(
    log: &(impl Engine + ?Sized),
    uid: Uid,
    expected: u64,
    effects: Effects,
) -> Result<Arc<Record>, LogError> {
    let position = RecordPosition {
        revision: expected,
        ..log.view(uid)?.position()
    };
    let record = Arc::new(Record::after(position, effects));
    accepted(log.submit(uid, Arc::clone(&record))?);
    Ok(record)
}

fn accepted(receipt: Receipt) {
    assert!(matches!(receipt, Receipt::Accepted));
}

/// Blocks this thread until a revision is durable, and returns the newest durable revision.
fn synced(log: &(impl Engine + ?Sized), uid: Uid, revision: u64) -> Result<u64, LogError> {
    if revision == 0 {
        return Ok(0);
    }
    let batch = next(&mut log.follow(uid, revision - 1))?;
    Ok(batch.last().unwrap().revision())
}

/// Blocks this thread until the stream has the next records.
fn next(records: &mut RecordStream) -> Result<Vec<Arc<Record>>, LogError> {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build();
    runtime.unwrap().block_on(records.next()).unwrap()
}

fn entry(name: &str) -> Entry {
    Entry {
        uid: Uid::unique(),
        name: name.into(),
        space: "R1".parse().unwrap(),
        payload_encoding: PayloadEncoding::Edges,
    }
}

/// Effects that store and remove ids of points; the state, the tag and the payload tell which effects they were.
fn effects(revision: u64, stored: &[u64], removed: &[u64]) -> Effects {
    let mut effects = Effects::new(1);
    for &id in stored {
        let point = PointRef {
            id,
            tag: revision,
            revision,
            row: &[revision as f64],
        };
        let payload = Bytes::from(format!("{id} at {revision}"));
        // The store looks for a point that it replaces, and there may be none.
        effects.store(point, Outcome::Replaced, payload);
    }
    for &id in removed {
        effects.remove(id);
    }
    effects
}

/// A retention of this many bytes of records of any age and of every operation.
fn retention(record_bytes: usize) -> Retention {
    Retention {
        record_bytes,
        since: SystemTime::UNIX_EPOCH,
        operations: usize::MAX,
        operation_bytes: usize::MAX,
    }
}

fn all_points(view: &dyn View) -> BTreeMap<u64, Arc<StoredPoint>> {
    let mut all = BTreeMap::new();
    let mut after = None;
    loop {
        let page = view.page(after, 3).unwrap();
        assert!(page.len() <= 3);
        let Some(last) = page.last() else {
            return all;
        };
        after = Some(last.id);
        assert!(page.is_sorted_by_key(|point| point.id));
        all.extend(page.into_iter().map(|point| (point.id, point)));
    }
}

/// Runs this many cases, the same in every run.
fn cases(cases: u32) -> ProptestConfig {
    ProptestConfig {
        cases,
        rng_seed: proptest::test_runner::RngSeed::Fixed(cases.into()),
        failure_persistence: None,
        ..ProptestConfig::default()
    }
}

#[test]
fn unknown_and_taken_uids_are_refused() {
    for kept in TestLog::of_every_kind() {
        check_uids(kept.log());
    }
}

fn check_uids(log: &dyn Engine) {
    let entry = entry("arm");
    let uid = entry.uid;
    let unknown = LogError::UnknownIndex { uid };
    assert_eq!(
        submit(log, uid, 0, effects(1, &[1], &[])).unwrap_err(),
        unknown
    );
    assert_eq!(log.read(uid, None, usize::MAX).unwrap_err(), unknown);
    assert_eq!(log.trim(uid, &retention(0)).unwrap_err(), unknown);
    assert_eq!(log.delete(uid).unwrap_err(), unknown);
    assert!(log.view(uid).is_err());
    log.create(entry.clone()).unwrap();
    assert_eq!(log.create(entry), Err(LogError::UidTaken { uid }));
}

/// A view that is held while a writer goes on shows exactly one revision.
#[test]
fn views_are_never_torn() {
    for kept in TestLog::of_every_kind() {
        check_views(kept.log());
    }
}

fn check_views(log: &dyn Engine) {
    const IDS: u64 = 2000;
    let entry = entry("arm");
    let uid = entry.uid;
    log.create(entry).unwrap();
    let ids: Vec<u64> = (0..IDS).collect();
    std::thread::scope(|scope| {
        scope.spawn(|| {
            for revision in 1..=30 {
                submit(log, uid, revision - 1, effects(revision, &ids, &[])).unwrap();
            }
        });
        for _ in 0..2 {
            scope.spawn(|| {
                loop {
                    let view = log.view(uid).unwrap();
                    let revision = view.revision();
                    for id in (0..IDS).step_by(97) {
                        let modified = view.get(id).unwrap().map_or(0, |point| point.modified);
                        assert_eq!(modified, revision);
                    }
                    if revision == 30 {
                        break;
                    }
                }
            });
        }
    });
}
