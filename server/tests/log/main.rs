//! What every store of the mutation log promises; each must pass the same.

#![expect(
    clippy::unwrap_used,
    reason = "a test that cannot go on has failed; clippy spares only what is marked as a test itself"
)]

mod fjall;

use std::{collections::BTreeMap, sync::Arc, time::SystemTime};

use bytes::Bytes;
use proptest::prelude::*;
use wayfold_index::PointRef;
use wayfold_server::log::{
    Durability, Effects, Entry, FjallLog, Keep, Log, LogError, MemoryLog, Outcome, Record,
    StoredPoint, Uid, View,
};

/// A log under test, which is closed and opened again where it can be.
struct Kept {
    log: Option<Box<dyn Log>>,
    directory: Option<tempfile::TempDir>,
}

impl Kept {
    fn in_memory() -> Self {
        Self {
            log: Some(Box::new(MemoryLog::new())),
            directory: None,
        }
    }

    fn on_disk() -> Self {
        let mut kept = Self {
            log: None,
            directory: Some(tempfile::tempdir().unwrap()),
        };
        kept.reopen();
        kept
    }

    fn log(&self) -> &dyn Log {
        &**self.log.as_ref().unwrap()
    }

    /// No view of it may be held.
    fn reopen(&mut self) {
        if let Some(directory) = &self.directory {
            self.log = None;
            let log = FjallLog::open(directory.path(), Durability::Fsync).unwrap();
            self.log = Some(Box::new(log));
        }
    }
}

fn entry(name: &str) -> Entry {
    Entry {
        uid: Uid::unique(),
        name: name.into(),
        space: "R1".parse().unwrap(),
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
        effects.store(point, Outcome::Inserted, payload);
    }
    for &id in removed {
        effects.remove(id);
    }
    effects
}

/// So many bytes of records, however old, and every operation.
fn keep(record_bytes: usize) -> Keep {
    Keep {
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

#[derive(Clone, Debug)]
enum Step {
    Append { store: Vec<u64>, remove: Vec<u64> },
    Stale { behind: u64 },
    Hold,
    Release(usize),
    Trim(usize),
    Reopen,
}

fn step() -> impl Strategy<Value = Step> {
    let ids = || prop::collection::btree_set(0..12u64, 0..4);
    prop_oneof![
        5 => (ids(), ids()).prop_map(|(store, remove)| Step::Append {
            remove: remove.difference(&store).copied().collect(),
            store: store.into_iter().collect(),
        }),
        1 => (1..3u64).prop_map(|behind| Step::Stale { behind }),
        2 => Just(Step::Hold),
        1 => (0..100usize).prop_map(Step::Release),
        1 => (0..2000usize).prop_map(Step::Trim),
        1 => Just(Step::Reopen),
    ]
}

/// The sum of the records in a sorted map, and whole copies of it for the views.
#[derive(Default)]
struct Model {
    points: BTreeMap<u64, Arc<StoredPoint>>,
    records: Vec<Arc<Record>>,
    trimmed: usize,
    next_id: u64,
}

impl Model {
    fn append(&mut self, store: &[u64], remove: &[u64]) -> Effects {
        let revision = self.records.len() as u64 + 1;
        let remove: Vec<u64> = remove
            .iter()
            .copied()
            .filter(|id| self.points.remove(id).is_some())
            .collect();
        for &id in store {
            let point = StoredPoint {
                id,
                revision,
                modified: revision,
                tag: revision,
                state: Box::new([revision as f64]),
                payload: Bytes::from(format!("{id} at {revision}")),
            };
            self.points.insert(id, Arc::new(point));
            self.next_id = self.next_id.max(id + 1);
        }
        effects(revision, store, &remove)
    }

    fn trim(&mut self, keep_bytes: usize) {
        let bytes = |records: &[Arc<Record>]| -> usize {
            records.iter().map(|record| record.effects().bytes()).sum()
        };
        while self.trimmed + 1 < self.records.len()
            && bytes(&self.records[self.trimmed..]) > keep_bytes
        {
            self.trimmed += 1;
        }
    }
}

fn check_log(mut kept: Kept, steps: Vec<Step>) {
    let (ours, other) = (entry("ours"), entry("other"));
    for entry in [&ours, &other] {
        kept.log().create(entry.clone()).unwrap();
    }
    let uid = ours.uid;
    let mut model = Model::default();
    let mut views = Vec::new();
    for step in steps {
        let head = model.records.len() as u64;
        if matches!(step, Step::Reopen) {
            views.clear();
            kept.reopen();
            // What was trimmed may come back, if nothing was appended since.
            let held = kept.log().tail(uid, None).unwrap().len();
            let trimmed = model.records.len() - held;
            assert!(trimmed <= model.trimmed);
            model.trimmed = trimmed;
        }
        let log = kept.log();
        match step {
            Step::Append { store, remove } => {
                let effects = model.append(&store, &remove);
                let record = log.append(uid, head, effects.clone()).unwrap();
                assert_eq!(record.revision(), head + 1);
                assert_eq!(*record.effects(), effects);
                assert!(record.is_intact());
                let previous = model
                    .records
                    .last()
                    .map_or(&Record::NO_PREVIOUS, |last| last.digest());
                assert_eq!(record.previous(), previous);
                model.records.push(record);
            }
            Step::Stale { behind } => {
                let expected = head.saturating_sub(behind);
                let refused = log.append(uid, expected, effects(expected + 1, &[1], &[]));
                if expected < head {
                    assert_eq!(
                        refused,
                        Err(LogError::Fenced {
                            uid,
                            expected,
                            head
                        })
                    );
                } else {
                    model.append(&[1], &[]);
                    model.records.push(refused.unwrap());
                }
            }
            Step::Hold => {
                let view = log.points(uid).unwrap();
                assert_eq!((view.revision(), view.next_id()), (head, model.next_id));
                views.push((view, model.points.clone()));
            }
            Step::Release(at) if !views.is_empty() => drop(views.swap_remove(at % views.len())),
            Step::Release(_) | Step::Reopen => {}
            Step::Trim(keep_bytes) => {
                log.trim(uid, &keep(keep_bytes)).unwrap();
                model.trim(keep_bytes);
            }
        }
        for (view, points) in &views {
            assert_eq!(all_points(&**view), *points);
            for id in 0..13 {
                assert_eq!(view.get(id).unwrap().as_ref(), points.get(&id));
            }
        }
        let held = &model.records[model.trimmed..];
        assert_eq!(log.tail(uid, None).unwrap(), held);
        for after in 0..=model.records.len() {
            let tail = log.tail(uid, Some(after as u64));
            if after < model.trimmed {
                let (after, oldest) = (after as u64, model.trimmed as u64);
                assert_eq!(tail, Err(LogError::Trimmed { uid, after, oldest }));
            } else {
                assert_eq!(tail.unwrap(), model.records[after..]);
            }
        }
    }
    // The neighbour is as it was, and views outlive their index.
    let log = kept.log();
    assert_eq!(log.points(other.uid).unwrap().revision(), 0);
    log.delete(uid).unwrap();
    assert_eq!(log.indexes().unwrap(), [other]);
    for (view, points) in &views {
        assert_eq!(all_points(&**view), *points);
    }
}

/// So many cases, the same in every run.
fn cases(cases: u32) -> ProptestConfig {
    ProptestConfig {
        cases,
        rng_seed: proptest::test_runner::RngSeed::Fixed(cases.into()),
        failure_persistence: None,
        ..ProptestConfig::default()
    }
}

proptest! {
    #![proptest_config(cases(256))]
    #[test]
    fn the_log_in_memory_is_the_sum_of_its_records(steps in prop::collection::vec(step(), 1..40)) {
        check_log(Kept::in_memory(), steps);
    }
}

proptest! {
    #![proptest_config(cases(48))]
    #[test]
    fn the_log_on_disk_is_the_sum_of_its_records(steps in prop::collection::vec(step(), 1..40)) {
        check_log(Kept::on_disk(), steps);
    }
}

#[test]
fn unknown_and_taken_uids_are_refused() {
    for kept in [Kept::in_memory(), Kept::on_disk()] {
        check_uids(kept.log());
    }
}

fn check_uids(log: &dyn Log) {
    let entry = entry("arm");
    let uid = entry.uid;
    let unknown = LogError::UnknownIndex { uid };
    assert_eq!(
        log.append(uid, 0, effects(1, &[1], &[])).unwrap_err(),
        unknown
    );
    assert_eq!(log.tail(uid, None).unwrap_err(), unknown);
    assert_eq!(log.trim(uid, &keep(0)).unwrap_err(), unknown);
    assert_eq!(log.delete(uid).unwrap_err(), unknown);
    assert!(log.points(uid).is_err());
    log.create(entry.clone()).unwrap();
    assert_eq!(log.create(entry), Err(LogError::UidTaken { uid }));
}

#[test]
fn who_has_all_records_but_the_newest_gets_it_however_large_it_is() {
    let log = MemoryLog::new();
    let entry = entry("arm");
    let uid = entry.uid;
    log.create(entry).unwrap();
    for revision in 1..=2 {
        log.append(uid, revision - 1, effects(revision, &[1], &[]))
            .unwrap();
        log.trim(uid, &keep(0)).unwrap();
        let tail = log.tail(uid, Some(revision - 1)).unwrap();
        assert_eq!(tail[0].revision(), revision);
    }
}

/// Readers hold views while a writer goes on: each sees one revision whole.
#[test]
fn views_are_never_torn() {
    for kept in [Kept::in_memory(), Kept::on_disk()] {
        check_views(kept.log());
    }
}

fn check_views(log: &dyn Log) {
    const IDS: u64 = 2000;
    let entry = entry("arm");
    let uid = entry.uid;
    log.create(entry).unwrap();
    let ids: Vec<u64> = (0..IDS).collect();
    std::thread::scope(|scope| {
        scope.spawn(|| {
            for revision in 1..=30 {
                log.append(uid, revision - 1, effects(revision, &ids, &[]))
                    .unwrap();
            }
        });
        for _ in 0..2 {
            scope.spawn(|| {
                loop {
                    let view = log.points(uid).unwrap();
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
