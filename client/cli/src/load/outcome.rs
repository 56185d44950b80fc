//! The result of a run, from which the table, the JSON and the report are made.

use std::time::{Duration, SystemTime};

use super::{
    machine::Machine,
    mix::Verb,
    record::Tally,
    settings::{Address, Phase},
    states::Range,
    target::ServerFacts,
};

/// A run, whole or ended early.
#[derive(Clone, Debug)]
pub(super) struct Outcome {
    pub(super) index: String,
    /// The text of the space.
    pub(super) space: String,
    pub(super) address: Address,
    /// The version and durability of the server, where the face tells them.
    pub(super) server: Option<ServerFacts>,
    pub(super) machine: Machine,
    pub(super) started: SystemTime,
    pub(super) seed: u64,
    pub(super) range: Range,
    pub(super) timeout: Duration,
    /// The tag of the points that the run stored.
    pub(super) tag: u64,
    /// The calls before the measurement, and the time that they took.
    pub(super) warmup: Option<(Duration, Tally)>,
    pub(super) phases: Vec<PhaseOutcome>,
    /// The measurement in steps of a second, or of more in a run of more than ten minutes.
    pub(super) steps: Vec<Step>,
    pub(super) points: PointCounts,
    /// The time until the server had acknowledged all writes of the shared indices.
    pub(super) flush: Duration,
    /// True if a signal ended the run.
    pub(super) is_interrupted: bool,
}

/// One phase.
#[derive(Clone, Debug)]
pub(super) struct PhaseOutcome {
    pub(super) phase: Phase,
    pub(super) tally: Tally,
    /// The time from the beginning of the measurement.
    pub(super) start: Duration,
    pub(super) elapsed: Duration,
    /// The calls that were due, in an open loop.
    pub(super) due: Option<u64>,
}

impl PhaseOutcome {
    /// The calls that were due and that no worker had time to begin.
    pub(super) fn not_begun(&self, made: u64) -> u64 {
        self.due.map_or(0, |due| due.saturating_sub(made))
    }
}

/// A part of the measurement, within one phase.
#[derive(Clone, Debug)]
pub(super) struct Step {
    /// The number of its phase, from 0.
    pub(super) phase: usize,
    /// The time from the beginning of the measurement.
    pub(super) start: Duration,
    pub(super) width: Duration,
    /// The answered calls of each verb, in the order of [`Verb::ALL`].
    pub(super) answered: [u64; Verb::ALL.len()],
    pub(super) failed: u64,
    pub(super) latency: Option<StepLatency>,
}

/// Latencies of the calls that were answered in a step, in nanoseconds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct StepLatency {
    pub(super) p50: u64,
    pub(super) p99: u64,
    pub(super) max: u64,
}

impl Step {
    pub(super) fn of(tally: &Tally, phase: usize, start: Duration, width: Duration) -> Step {
        let total = tally.total();
        let latency = total.latencies().map(|latencies| StepLatency {
            p50: latencies.value_at_quantile(0.5),
            p99: latencies.value_at_quantile(0.99),
            max: latencies.max(),
        });
        Step {
            phase,
            start,
            width,
            answered: Verb::ALL.map(|verb| tally.of(verb).answered()),
            failed: total.failed(),
            latency,
        }
    }

    /// Adds a few calls to a step. Its percentiles stay, but not its maximum.
    pub(super) fn add(&mut self, tally: &Tally) {
        let splinter = Step::of(tally, self.phase, self.start, self.width);
        self.failed += splinter.failed;
        for (answered, more) in self.answered.iter_mut().zip(splinter.answered) {
            *answered += more;
        }
        self.latency = match (self.latency, splinter.latency) {
            (Some(latency), Some(more)) => Some(StepLatency {
                max: latency.max.max(more.max),
                ..latency
            }),
            (latency, more) => latency.or(more),
        };
    }

    pub(super) fn per_second(&self, count: u64) -> f64 {
        per_second(count, self.width)
    }
}

/// The points of the index, before, during and after the run.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct PointCounts {
    pub(super) before: u64,
    /// Those that the run stored before its first call.
    pub(super) filled: u64,
    /// Those of the answered inserts, the warm-up's included.
    pub(super) inserted: u64,
    /// The writes that the server did not take although the shared index had answered them.
    pub(super) unsent: u64,
    pub(super) removed: u64,
    /// None if the server did not tell.
    pub(super) after: Option<u64>,
    /// True if the points of the run stay.
    pub(super) are_kept: bool,
}

impl Outcome {
    /// The calls of all phases.
    pub(super) fn total(&self) -> Tally {
        let mut total = Tally::default();
        for phase in &self.phases {
            total.add(&phase.tally);
        }
        total
    }

    /// The time of all phases.
    pub(super) fn elapsed(&self) -> Duration {
        self.phases.iter().map(|phase| phase.elapsed).sum()
    }
}

pub(super) fn per_second(count: u64, time: Duration) -> f64 {
    match time.is_zero() {
        true => 0.0,
        false => count as f64 / time.as_secs_f64(),
    }
}
