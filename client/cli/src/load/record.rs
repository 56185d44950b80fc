//! The outcomes of the calls: latencies by verb, and failures by reason.

use std::{
    collections::BTreeMap,
    sync::{Mutex, MutexGuard, PoisonError},
    time::Duration,
};

use hdrhistogram::Histogram;
use wayfold::{Code, Error};

use super::mix::Verb;

/// The kind of a failure.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Kind {
    /// The server refused the call.
    Refused,
    /// No answer came within the timeout.
    Expired,
    /// There was no connection, or it broke.
    Lost,
    /// Any other error.
    Failed,
}

impl Kind {
    pub(super) fn name(self) -> &'static str {
        match self {
            Kind::Refused => "refused",
            Kind::Expired => "expired",
            Kind::Lost => "lost",
            Kind::Failed => "failed",
        }
    }
}

/// A kind of failure, and the server's reason for it; the reason is empty unless it is a refusal.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Cause {
    pub(super) kind: Kind,
    pub(super) reason: String,
}

impl Cause {
    pub(super) fn of(error: &Error) -> Cause {
        let cause = |kind, reason: &str| Cause {
            kind,
            reason: reason.to_owned(),
        };
        match error {
            Error::Partial { source, .. } => Cause::of(source),
            Error::WritesRefused { why } | Error::Ended { why } => Cause::of(why),
            Error::Refused(refusal) if refusal.code == Code::DeadlineExceeded => {
                cause(Kind::Expired, "")
            }
            Error::Refused(refusal) => match refusal.reason.as_str() {
                "" => cause(Kind::Refused, refusal.code_name()),
                reason => cause(Kind::Refused, reason),
            },
            Error::Timeout { .. } | Error::SearchTimeout => cause(Kind::Expired, ""),
            Error::Connection { .. } => cause(Kind::Lost, ""),
            _ => cause(Kind::Failed, ""),
        }
    }
}

/// The failures of one cause.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Failures {
    pub(super) count: u64,
    /// The message of the first one.
    pub(super) first: String,
}

/// The calls of one verb.
#[derive(Clone, Debug, Default)]
pub(super) struct VerbTally {
    /// Nanoseconds of the answered calls; `None` until there is one.
    latencies: Option<Histogram<u64>>,
    /// The states or ids of the answered calls.
    pub(super) rows: u64,
    pub(super) failures: BTreeMap<Cause, Failures>,
}

impl VerbTally {
    /// The number of answered calls.
    pub(super) fn answered(&self) -> u64 {
        self.latencies.as_ref().map_or(0, Histogram::len)
    }

    /// The number of failed calls.
    pub(super) fn failed(&self) -> u64 {
        self.failures.values().map(|failures| failures.count).sum()
    }

    pub(super) fn made(&self) -> u64 {
        self.answered() + self.failed()
    }

    /// The latencies of the answered calls in nanoseconds, if there are any.
    pub(super) fn latencies(&self) -> Option<&Histogram<u64>> {
        self.latencies.as_ref()
    }

    fn answer(&mut self, latency: Duration, rows: u64) {
        let nanoseconds = u64::try_from(latency.as_nanos()).unwrap_or(u64::MAX);
        let latencies = self.latencies.get_or_insert_with(histogram);
        latencies.saturating_record(nanoseconds);
        self.rows += rows;
    }

    fn fail(&mut self, cause: Cause, first: impl FnOnce() -> String) {
        let failures = self.failures.entry(cause).or_insert_with(|| Failures {
            count: 0,
            first: first(),
        });
        failures.count += 1;
    }

    /// Adds the calls of another tally.
    pub(super) fn add(&mut self, other: &VerbTally) {
        if let Some(others) = &other.latencies {
            let latencies = self.latencies.get_or_insert_with(histogram);
            // Both have the same bounds.
            let _ = latencies.add(others);
        }
        self.rows += other.rows;
        for (cause, others) in &other.failures {
            let failures = self
                .failures
                .entry(cause.clone())
                .or_insert_with(|| Failures {
                    count: 0,
                    first: others.first.clone(),
                });
            failures.count += others.count;
        }
    }
}

/// Latencies above an hour are recorded as an hour.
const MAX_LATENCY_NS: u64 = 3_600_000_000_000;

/// A histogram whose values are off by a thousandth at most.
fn histogram() -> Histogram<u64> {
    const DIGITS: u8 = 3;
    let made = Histogram::new_with_max(MAX_LATENCY_NS, DIGITS);
    // Neither constant is out of range.
    made.expect("an hour in three digits")
}

/// The calls of all verbs.
#[derive(Clone, Debug, Default)]
pub(super) struct Tally([VerbTally; Verb::ALL.len()]);

impl Tally {
    /// Records the end of a call of `rows` states or ids.
    pub(super) fn record(
        &mut self,
        verb: Verb,
        rows: usize,
        latency: Duration,
        failure: Option<&Error>,
    ) {
        let tally = &mut self.0[verb as usize];
        match failure {
            None => tally.answer(latency, rows as u64),
            Some(error) => tally.fail(Cause::of(error), || error.to_string()),
        }
    }

    pub(super) fn of(&self, verb: Verb) -> &VerbTally {
        &self.0[verb as usize]
    }

    /// The verbs that were called, with their calls.
    pub(super) fn called(&self) -> impl Iterator<Item = (Verb, &VerbTally)> {
        let all = Verb::ALL.into_iter().zip(&self.0);
        all.filter(|(_, tally)| tally.made() > 0)
    }

    /// All verbs together.
    pub(super) fn total(&self) -> VerbTally {
        let mut total = VerbTally::default();
        self.0.iter().for_each(|tally| total.add(tally));
        total
    }

    pub(super) fn add(&mut self, other: &Tally) {
        for (tally, other) in self.0.iter_mut().zip(&other.0) {
            tally.add(other);
        }
    }
}

/// The tallies that workers write and the run empties. A worker has one that few others write.
///
/// A call counts in the step in which it ended, by its own clock, however late the run looks.
#[derive(Debug)]
pub(super) struct Recorder {
    /// The length of a step.
    step: Duration,
    /// The tallies of the steps that were not drained, by the number of the step.
    shards: Vec<Mutex<BTreeMap<u32, Tally>>>,
}

/// The most tallies at a time: a histogram takes some hundred kilobytes.
const MAX_SHARDS: usize = 16;

impl Recorder {
    pub(super) fn new(workers: usize, step: Duration) -> Recorder {
        let shards = workers.clamp(1, MAX_SHARDS);
        Recorder {
            step,
            shards: (0..shards).map(|_| Mutex::default()).collect(),
        }
    }

    /// The number of the step at a time from the beginning of the phase.
    pub(super) fn step_at(&self, time: Duration) -> u32 {
        (time.as_secs_f64() / self.step.as_secs_f64()) as u32
    }

    fn shard(&self, shard: usize) -> MutexGuard<'_, BTreeMap<u32, Tally>> {
        let shard = &self.shards[shard % self.shards.len()];
        shard.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Lets a worker write the tally of the step in which its call ended.
    pub(super) fn write(&self, worker: usize, ended: Duration, write: impl FnOnce(&mut Tally)) {
        let step = self.step_at(ended);
        write(self.shard(worker).entry(step).or_default());
    }

    /// The calls of the steps before `end` that were not drained, by the number of the step.
    pub(super) fn drain(&self, end: u32) -> BTreeMap<u32, Tally> {
        let mut all: BTreeMap<u32, Tally> = BTreeMap::new();
        for shard in 0..self.shards.len() {
            let drained = {
                let mut steps = self.shard(shard);
                let rest = steps.split_off(&end);
                std::mem::replace(&mut *steps, rest)
            };
            for (step, tally) in drained {
                all.entry(step).or_default().add(&tally);
            }
        }
        all
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn lost() -> Error {
        Error::Connection {
            call: "knn",
            uri: "http://there:1".into(),
            source: "gone".into(),
        }
    }

    #[test]
    fn records_of_workers_are_drained_once_and_by_step() {
        let second = Duration::from_secs(1);
        let recorder = Recorder::new(40, second);
        for worker in 0..40 {
            let ms = Duration::from_millis(worker as u64 + 1);
            let ended = if worker < 30 { second / 2 } else { second };
            recorder.write(worker, ended, |tally| tally.record(Verb::Knn, 5, ms, None));
        }
        let error = lost();
        recorder.write(3, second / 4, |tally| {
            tally.record(Verb::Get, 5, Duration::ZERO, Some(&error));
        });
        let first = recorder.drain(1);
        assert_eq!(first.keys().collect::<Vec<_>>(), [&0]);
        let knn = first[&0].of(Verb::Knn);
        assert_eq!((knn.answered(), knn.failed(), knn.rows), (30, 0, 150));
        let max = knn.latencies().unwrap().max();
        assert!((30_000_000..30_100_000).contains(&max), "{max}");
        assert_eq!(first[&0].of(Verb::Get).failed(), 1);
        assert_eq!(first[&0].total().made(), 31);
        assert!(recorder.drain(1).is_empty());
        let rest = recorder.drain(u32::MAX);
        assert_eq!((rest.len(), rest[&1].total().made()), (1, 10));
    }

    #[test]
    fn failures_have_a_kind_and_keep_the_first_message() {
        let mut tally = Tally::default();
        let timeout = Error::Timeout {
            call: "knn",
            timeout: Duration::from_secs(1),
            earlier: None,
        };
        let partial = Error::Partial {
            done: 1,
            rows: 2,
            ids: vec![7],
            source: Box::new(lost()),
        };
        for error in [
            &timeout,
            &lost(),
            &partial,
            &Error::Closed,
            &Error::SearchTimeout,
        ] {
            tally.record(Verb::Knn, 1, Duration::ZERO, Some(error));
        }
        let total = tally.total();
        let counts = total.failures.iter();
        let counts: Vec<_> = counts.map(|(cause, of)| (cause.kind, of.count)).collect();
        assert_eq!(
            counts,
            [(Kind::Expired, 2), (Kind::Lost, 2), (Kind::Failed, 1)]
        );
        let first = &total.failures.values().next().unwrap().first;
        assert_eq!(*first, timeout.to_string());
    }

    #[test]
    fn latencies_keep_three_digits_from_a_nanosecond_to_an_hour() {
        for latency in [
            Duration::from_nanos(1),
            Duration::from_micros(123),
            Duration::from_secs(3000),
        ] {
            let mut tally = Tally::default();
            tally.record(Verb::Insert, 1, latency, None);
            let max = tally.of(Verb::Insert).latencies().unwrap().max() as f64;
            let exact = latency.as_nanos() as f64;
            assert!((max / exact - 1.0).abs() < 1e-3, "{max} {exact}");
        }
    }
}
