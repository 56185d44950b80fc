//! One suite for every store: after any sequence of calls, a log equals the sum of its records.

use std::{
    sync::Arc,
    time::{Duration, SystemTime},
};

use proptest::prelude::*;
use wayfold_server::log::{Effects, Entry, LogError, Origin, Record, Retention, StoredPoint, View};

use crate::{
    all_points, cases, effects, entry,
    model::{Model, NextBatch, Sum, check_view},
    submit, synced,
    test_log::TestLog,
};

#[derive(Clone, Debug)]
enum Step {
    /// `operation` is the size of the operation in bytes; 0 appends without one.
    Append {
        store: Vec<u64>,
        remove: Vec<u64>,
        operation: usize,
        batch: Option<NextBatch>,
    },
    Stale {
        behind: u64,
    },
    Hold,
    Release(usize),
    Trim {
        record_bytes: usize,
        operations: usize,
        operation_bytes: usize,
        /// The place of a held record: records before it are too old. It has no effect if fewer records are held.
        oldest: usize,
    },
    Sync,
    /// The log is closed in order and reopened.
    Reopen,
    /// The log ends without closing and is reopened.
    Cut,
    /// The writing call after this many others fails.
    Fail(u64),
    /// A copy of the index is made; a finished copy replaces the index.
    Copy {
        finished: bool,
    },
}

fn step() -> impl Strategy<Value = Step> {
    let ids = || prop::collection::btree_set(0..12u64, 0..4);
    let batch = (0..4usize, 0..4u64, prop::bool::weighted(0.2))
        .prop_map(|(of, reserve, end)| NextBatch { of, reserve, end });
    let some = |most: usize| prop_oneof![Just(usize::MAX), 0..most];
    prop_oneof![
        8 => (ids(), ids(), 0..40usize, prop::option::of(batch)).prop_map(
            |(store, remove, bytes, batch)| Step::Append {
                remove: remove.difference(&store).copied().collect(),
                store: store.into_iter().collect(),
                operation: bytes.saturating_sub(20),
                batch,
            }
        ),
        1 => (1..3u64).prop_map(|behind| Step::Stale { behind }),
        2 => Just(Step::Hold),
        1 => (0..100usize).prop_map(Step::Release),
        2 => (some(2000), some(5), some(100), 0..12usize).prop_map(
            |(record_bytes, operations, operation_bytes, oldest)| Step::Trim {
                record_bytes, operations, operation_bytes, oldest,
            }
        ),
        2 => Just(Step::Sync),
        1 => Just(Step::Reopen),
        1 => Just(Step::Cut),
        2 => (0..4u64).prop_map(Step::Fail),
        1 => any::<bool>().prop_map(|finished| Step::Copy { finished }),
    ]
}

/// A log, its model, and the held views of it.
struct Run {
    kept: TestLog,
    ours: Entry,
    other: Entry,
    model: Model,
    views: Vec<(Arc<dyn View>, Sum)>,
}

impl Run {
    fn new(kept: TestLog) -> Self {
        let (ours, other) = (entry("ours"), entry("other"));
        for entry in [&ours, &other] {
            kept.log().create(entry.clone()).unwrap();
        }
        let model = Model::new(Origin::START, Sum::default());
        let views = Vec::new();
        Self {
            kept,
            ours,
            other,
            model,
            views,
        }
    }

    fn step(&mut self, step: Step) {
        let (log, uid, head) = (self.kept.log(), self.ours.uid, self.model.head());
        match step {
            Step::Append {
                store,
                remove,
                operation,
                batch,
            } => {
                let effects = self.model.next(&store, &remove, operation, batch);
                match submit(log, uid, head, effects.clone()) {
                    Ok(record) => self.model.append(record, &effects),
                    Err(why) => self.recover(&why, Some(&effects)),
                }
            }
            Step::Stale { behind } if behind <= head => {
                let expected = head - behind;
                let refused = submit(log, uid, expected, effects(expected + 1, &[1], &[]));
                assert_eq!(refused, Err(LogError::fenced(uid, expected, head)));
            }
            Step::Stale { .. } => {}
            Step::Hold => {
                let view = log.view(uid).unwrap();
                self.views.push((view, self.model.newest().clone()));
            }
            Step::Release(at) if !self.views.is_empty() => {
                let at = at % self.views.len();
                drop(self.views.swap_remove(at));
            }
            Step::Release(_) => {}
            Step::Trim {
                record_bytes,
                operations,
                operation_bytes,
                oldest,
            } => {
                let oldest = self.model.records[self.model.trimmed..].get(oldest);
                let since = oldest.map_or(0, |record| record.time_ms());
                let retention = Retention {
                    record_bytes,
                    since: SystemTime::UNIX_EPOCH + Duration::from_millis(since),
                    operations,
                    operation_bytes,
                };
                match log.trim(uid, &retention) {
                    Ok(()) => self.model.trim(&retention),
                    Err(why) => {
                        // The trim may have taken effect or not.
                        self.views.clear();
                        let (records, operations) =
                            (self.model.trimmed, self.model.operations_trimmed);
                        self.model.trim(&retention);
                        let may = (self.model.trimmed, self.model.operations_trimmed);
                        (self.model.trimmed, self.model.operations_trimmed) = (records, operations);
                        self.failed(&why);
                        self.reopen_failed(None, may);
                    }
                }
            }
            Step::Sync => match self.wait_synced() {
                Ok(synced) => {
                    assert_eq!(synced, head);
                    self.model.synced = self.model.records.len();
                }
                Err(why) => self.recover(&why, None),
            },
            Step::Reopen => {
                self.views.clear();
                self.model.synced = self.model.records.len();
                self.kept.reopen();
                self.model.rejoin(self.kept.log(), uid, None);
            }
            Step::Cut => {
                self.views.clear();
                self.kept.cut();
                self.model.rejoin(self.kept.log(), uid, None);
            }
            Step::Fail(after) => {
                self.kept.fail_after(after);
            }
            Step::Copy { finished } => self.copy(finished),
        }
        self.check();
    }

    fn check(&self) {
        let log = self.kept.log();
        self.model.check(log, self.ours.uid);
        assert_eq!(log.view(self.other.uid).unwrap().revision(), 0);
        for (view, sum) in &self.views {
            check_view(&**view, sum);
        }
    }

    fn wait_synced(&self) -> Result<u64, LogError> {
        let head = self.model.head();
        match self.model.records.is_empty() {
            true => Ok(head),
            false => synced(self.kept.log(), self.ours.uid, head),
        }
    }

    /// Checks the log after a call that failed. The call has changed nothing visible, the log refuses further writes,
    /// and reads go on. After the log is reopened, the unknown mutation is stored whole or not at all.
    fn recover(&mut self, why: &LogError, unknown: Option<&Effects>) {
        let may = (self.model.trimmed, self.model.operations_trimmed);
        self.failed(why);
        self.reopen_failed(unknown, may);
    }

    fn failed(&self, why: &LogError) {
        assert!(matches!(why, LogError::Storage { .. }), "{why}");
        self.check();
        let log = self.kept.log();
        assert_eq!(log.failure().as_ref(), Some(why));
        let refused = submit(log, self.ours.uid, self.model.head(), effects(1, &[1], &[]));
        assert_eq!(refused.as_ref(), Err(why));
        assert_eq!(log.create(entry("new")).as_ref(), Err(why));
        assert_eq!(log.delete(self.other.uid).as_ref(), Err(why));
        self.check();
    }

    /// `may` is the limit up to which records and operations may have been trimmed.
    fn reopen_failed(&mut self, unknown: Option<&Effects>, may: (usize, usize)) {
        let log = self.kept.log();
        log.reopen().unwrap();
        assert_eq!(log.failure(), None);
        for (view, _) in self.views.drain(..) {
            assert_eq!(view.get(0), Err(LogError::Closed));
            assert_eq!(view.page(None, 1), Err(LogError::Closed));
        }
        (self.model.trimmed, self.model.operations_trimmed) = may;
        self.model.rejoin(log, self.ours.uid, unknown);
    }

    /// Copies the index under another uid, in parts; a finished copy replaces it.
    fn copy(&mut self, finished: bool) {
        let log = self.kept.log();
        let sum = self.model.newest().clone();
        let origin = Origin {
            revision: self.model.head(),
            next_id: sum.next_id,
            digest: self.model.digest(),
        };
        let copy = entry("copy");
        let stored: Vec<StoredPoint> = sum.points.values().map(|point| (**point).clone()).collect();
        let copying = log.restore(copy.clone(), origin, false);
        let copied = copying.and_then(|mut copying| {
            for part in stored.chunks(3) {
                copying.add(part)?;
                assert!(log.view(copy.uid).is_err(), "it is not there yet");
            }
            match finished {
                true => copying.finish(sum.sessions(), vec![]),
                false => Ok(()),
            }
        });
        let made = match copied {
            Ok(()) => finished,
            Err(why) => {
                self.recover(&why, None);
                self.kept.log().indexes().unwrap().contains(&copy)
            }
        };
        let log = self.kept.log();
        assert_eq!(log.view(copy.uid).is_ok(), made);
        assert_eq!(log.indexes().unwrap().len(), 2 + usize::from(made));
        if made {
            let before = std::mem::replace(&mut self.ours, copy);
            self.views.clear();
            self.model = Model::new(origin, sum);
            self.check();
            if let Err(why) = log.delete(before.uid) {
                self.recover(&why, None);
                let log = self.kept.log();
                if log.indexes().unwrap().contains(&before) {
                    assert_eq!(log.view(before.uid).unwrap().revision(), origin.revision);
                    log.delete(before.uid).unwrap();
                }
            }
        }
    }
}

/// A store that applies the records of another becomes equal to it and serves the same records to followers.
fn check_applied(kept: &TestLog, model: &Model) {
    let (log, entry) = (kept.log(), entry("applied"));
    let (origin, sum) = model.origin();
    let mut copying = log.restore(entry.clone(), origin, false).unwrap();
    for point in sum.points.values() {
        copying.add(std::slice::from_ref(&**point)).unwrap();
    }
    copying.finish(sum.sessions(), vec![]).unwrap();
    for (at, records) in model.records.chunks(3).enumerate() {
        let view = log.apply(entry.uid, records).unwrap();
        assert_eq!(view.position(), records.last().unwrap().position());
        let applied = model.sum_after(3 * at + records.len());
        check_view(&*view, applied);
        // Applied records are not applied again, and none is skipped.
        assert_eq!(
            log.apply(entry.uid, records).unwrap().position(),
            view.position()
        );
        check_view(&*log.view(entry.uid).unwrap(), applied);
        let unlinked = Record::new(view.revision() + 1, [7; 32], 0, Effects::new(1));
        let refused = log.apply(entry.uid, &[Arc::new(unlinked)]).err();
        assert!(
            matches!(refused, Some(LogError::JournalDamaged { .. })),
            "{refused:?}"
        );
    }
    // A journal elsewhere gets no records from the point store.
    if !matches!(kept, TestLog::Remote(_))
        && let Some(last) = model.records.last()
    {
        synced(log, entry.uid, last.revision()).unwrap();
        assert_eq!(
            log.read(entry.uid, None, usize::MAX).unwrap(),
            model.records
        );
    }
}

fn check_log(kept: TestLog, steps: Vec<Step>) {
    let mut run = Run::new(kept);
    for step in steps {
        run.step(step);
    }
    check_applied(&run.kept.another(), &run.model);
    // The neighbouring index is unchanged, and views outlive their index.
    let log = run.kept.log();
    if let Err(why) = log.delete(run.ours.uid) {
        return run.failed(&why);
    }
    assert_eq!(log.indexes().unwrap(), [run.other]);
    for (view, sum) in &run.views {
        assert_eq!(all_points(&**view), sum.points);
    }
}

proptest! {
    #![proptest_config(cases(256))]
    #[test]
    fn the_log_in_memory_is_the_sum_of_its_records(steps in prop::collection::vec(step(), 1..40)) {
        check_log(TestLog::in_memory(), steps);
    }
}

proptest! {
    #![proptest_config(cases(48))]
    #[test]
    fn the_log_on_disk_is_the_sum_of_its_records(steps in prop::collection::vec(step(), 1..40)) {
        check_log(TestLog::on_disk(), steps);
    }
}

proptest! {
    #![proptest_config(cases(1024))]
    #[test]
    fn the_log_that_fails_is_the_sum_of_its_records(
        seed in any::<u64>(),
        steps in prop::collection::vec(step(), 1..40),
    ) {
        check_log(TestLog::faulty(seed), steps);
    }
}

proptest! {
    #![proptest_config(cases(96))]
    #[test]
    fn the_log_with_a_journal_elsewhere_is_the_sum_of_its_records(
        seed in any::<u64>(),
        steps in prop::collection::vec(step(), 1..40),
    ) {
        check_log(TestLog::remote(seed), steps);
    }
}

proptest! {
    #![proptest_config(cases(12))]
    #[ignore = "needs nats-server"]
    #[test]
    fn the_log_in_nats_is_the_sum_of_its_records(steps in prop::collection::vec(step(), 1..40)) {
        // Its journal keeps all records, and no copy of an index begins in it.
        let possible = |step: &Step| !matches!(step, Step::Trim { .. } | Step::Copy { .. });
        check_log(TestLog::in_nats(), steps.into_iter().filter(possible).collect());
    }
}
