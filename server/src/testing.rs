//! Logs for unit tests, and the number of their cases.

use std::{sync::Arc, time::SystemTime};

use proptest::{prelude::ProptestConfig, test_runner::RngSeed};
use wayfold_index::PointRef;

use crate::log::{
    Catalogue, Effects, Entry, Journal, MemoryLog, Operation, Outcome, PointStore, Record,
    Retention, Uid,
};

/// A new index `arm` of R1.
pub(crate) fn arm() -> Entry {
    Entry {
        uid: Uid::unique(),
        name: "arm".into(),
        space: "R1".parse().expect("a space"),
        payload_encoding: Default::default(),
    }
}

/// A log with an index that has applied these records.
pub(crate) fn log_with(entry: &Entry, records: &[Arc<Record>]) -> Arc<MemoryLog> {
    let log = Arc::new(MemoryLog::new());
    log.create(entry.clone()).expect("a new index");
    for record in records {
        append(&log, entry.uid, record);
    }
    log
}

/// A log with an index `arm` of R1 that has applied this many records without points.
pub(crate) fn recorded(records: u64) -> Arc<MemoryLog> {
    let entry = arm();
    let log = log_with(&entry, &[]);
    for _ in 0..records {
        let position = log.view(entry.uid).expect("a view").position();
        let record = Record::after(position, Effects::new(1));
        append(&log, entry.uid, &Arc::new(record));
    }
    log
}

fn append(log: &MemoryLog, uid: Uid, record: &Arc<Record>) {
    log.submit(uid, Arc::clone(record)).expect("a receipt");
    log.apply(uid, &[Arc::clone(record)]).expect("a view");
}

/// Submits and applies the next record, which no other log has: it stores a point with a payload and has an operation.
pub(crate) fn submit(log: &MemoryLog, uid: Uid) {
    let position = log.view(uid).expect("a view").position();
    let mut effects = Effects::new(1);
    let point = PointRef {
        id: position.revision,
        tag: 0,
        revision: position.revision + 1,
        row: &[0.5],
    };
    effects.store(point, Outcome::Inserted, vec![7; 30_000].into());
    effects.set_operation(Some(Arc::new(Operation {
        id: format!("operation {}", position.revision + 1),
        fingerprint: [1; 32],
        response: Default::default(),
    })));
    let run = *Uid::unique().as_bytes();
    append(log, uid, &Arc::new(Record::made_by(run, position, effects)));
}

/// Trims all but the newest record.
pub(crate) fn trim_all(log: &MemoryLog, uid: Uid) {
    let retention = Retention {
        record_bytes: 0,
        since: SystemTime::UNIX_EPOCH,
        operations: usize::MAX,
        operation_bytes: usize::MAX,
    };
    log.trim(uid, &retention).expect("an index");
}

/// Property tests run `cases` cases, the same ones in every run.
pub(crate) fn cases(cases: u32) -> ProptestConfig {
    ProptestConfig {
        cases,
        rng_seed: RngSeed::Fixed(cases.into()),
        failure_persistence: None,
        ..ProptestConfig::default()
    }
}
