//! Logs, servers and admissions for unit tests, and the number of their cases.

use std::{sync::Arc, time::SystemTime};

use proptest::{prelude::ProptestConfig, test_runner::RngSeed};
use wayfold_index::PointRef;

use crate::{
    admission::{Admission, AdmissionConfig},
    config::Config,
    log::{
        Catalogue, Effects, Entry, Journal, Log, MemoryLog, Operation, Origin, Outcome, PointStore,
        Record, RecordPosition, Retention, Sessions, StoredPoint, Uid,
    },
    registry::{Registry, RegistryOptions},
    service::{Limits, Service},
};

/// Forwards `submit` and `read` of a `Journal` that other servers share to the field of a log.
macro_rules! forward_journal {
    ($field:ident) => {
        fn submit(
            &self,
            uid: Uid,
            record: Arc<$crate::log::Record>,
        ) -> Result<$crate::log::Receipt, LogError> {
            self.$field.submit(uid, record)
        }

        fn read(
            &self,
            uid: Uid,
            after: Option<u64>,
            max_bytes: usize,
        ) -> Result<Vec<Arc<$crate::log::Record>>, LogError> {
            self.$field.read(uid, after, max_bytes)
        }

        fn is_shared(&self) -> bool {
            true
        }
    };
}

pub(crate) use forward_journal;

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
    log_with(&arm(), &more(&[], 0, records))
}

/// These records, and this many more of a run without points.
pub(crate) fn more(records: &[Arc<Record>], run: u8, count: u64) -> Vec<Arc<Record>> {
    let mut all = records.to_vec();
    for _ in 0..count {
        let last = all.last();
        let position = last.map_or(RecordPosition::START, |last| last.position());
        let record = Record::made_by([run; 16], position, Effects::new(1));
        all.push(Arc::new(record));
    }
    all
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

/// A log with an index that has this many records of [`submit`].
pub(crate) fn engine(entry: &Entry, records: u64) -> Arc<MemoryLog> {
    let engine = log_with(entry, &[]);
    (0..records).for_each(|_| submit(&engine, entry.uid));
    engine
}

/// A log whose index has a point that no index of the space can have, so that no server can read it.
pub(crate) fn unreadable(entry: &Entry) -> Arc<MemoryLog> {
    let log = Arc::new(MemoryLog::new());
    let origin = Origin {
        revision: 3,
        next_id: 1,
        digest: [1; 32],
    };
    let damaged = log.restore(entry.clone(), origin, false);
    let mut damaged = damaged.expect("a new index");
    let wide = StoredPoint {
        id: 0,
        revision: 1,
        modified: 1,
        tag: 0,
        state: Box::new([0.5, 0.5]),
        payload: Default::default(),
    };
    damaged.add(&[wide]).expect("a point");
    let finished = damaged.finish(Sessions::default(), Vec::new());
    finished.expect("an index");
    log
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

/// A registry that has replayed `local`, and takes its records from another journal.
pub(crate) fn registry(
    journal: &Arc<impl Journal + 'static>,
    local: &Arc<MemoryLog>,
    options: RegistryOptions,
) -> Registry {
    let log = Log {
        journal: Arc::clone(journal) as Arc<dyn Journal>,
        ..Log::from(Arc::clone(local))
    };
    let registry = Registry::new(log, options);
    registry.replay().expect("the indices");
    registry
}

/// The service of a server with such a registry, which is ready.
pub(crate) fn server(journal: &Arc<impl Journal + 'static>, local: &Arc<MemoryLog>) -> Service {
    let registry = registry(journal, local, RegistryOptions::default());
    let service = Service::new(registry, Limits::default());
    service.set_ready();
    service
}

/// An admission whose calls and unread answers hold at most this many bytes.
pub(crate) fn admission(max_bytes: usize) -> Admission {
    let config = AdmissionConfig {
        max_bytes,
        ..Config::default().admission
    };
    Admission::new(&config, 1, 0)
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
