//! The result as one JSON object. The help text of the command documents the fields.

use std::{collections::BTreeMap, time::Duration};

use serde::Serialize;

use super::{
    machine::utc,
    mix::Verb,
    outcome::{Outcome, PhaseOutcome, Step, per_second},
    record::{Cause, Failures, Tally, VerbTally},
};
use crate::verb::durability_words;

/// The documentation of the fields.
pub(super) const FIELDS: &str = "\
The JSON object:
  index, space, face, server, prefix, seed, timeout_s, range: the settings
  tag: of the points of the run, in hexadecimal
  started: the time in UTC
  interrupted: true if a signal ended the run
  server_version, durability: of the server; null unless the face is grpc
  machine: the machine of the callers
  points: before, filled, inserted, removed, after: numbers of points;
    unsent: writes that a shared index had answered and the server did not take;
    flush_s: seconds until the server had acknowledged all writes
  warmup: calls, answered, failed, elapsed_s before the measurement; null without one
  phases: an object for each, with
    name, workers, batch, k, radius, mix, rate_per_s (calls due): the settings
    loop: \"open\" or \"closed\"
    start_s, elapsed_s: from the beginning of the measurement, and the time of the phase
    due: calls, null in a closed loop; not_begun: those of them that no worker began
    calls, answered, failed: numbers of calls
    answered_per_s: calls; rows_per_s: states or ids of answered calls
    latency_ms: p50, p90, p99, p99_9, max, mean of answered calls, null if there are none;
      it counts from the due time in an open loop, and from the call in a closed one
    failures: kind (refused, expired, lost, failed), reason (the server's), count,
      first (its message)
    verbs: by the name of the verb, an object with the fields from calls to failures
  total: elapsed_s of all phases, and the fields from calls to verbs
  steps: of the whole measurement, an object for each second with phase (from 0), start_s,
    width_s, answered (calls by verb), failed, p50_ms, p99_ms, max_ms (null without answers)";

#[derive(Serialize)]
pub(super) struct Line<'a> {
    index: &'a str,
    space: &'a str,
    face: &'static str,
    server: &'a str,
    prefix: Option<&'a str>,
    server_version: Option<&'a str>,
    durability: Option<&'static str>,
    machine: MachineFields<'a>,
    started: String,
    interrupted: bool,
    seed: u64,
    range: [f64; 2],
    timeout_s: f64,
    tag: String,
    points: Points,
    warmup: Option<Warmup>,
    phases: Vec<Phase<'a>>,
    total: Total,
    steps: Vec<StepFields>,
}

#[derive(Serialize)]
struct MachineFields<'a> {
    processor: &'a str,
    processors: usize,
    memory_bytes: Option<u64>,
    system: &'a str,
}

#[derive(Serialize)]
struct Points {
    before: u64,
    filled: u64,
    inserted: u64,
    removed: u64,
    after: u64,
    unsent: u64,
    flush_s: f64,
}

#[derive(Serialize)]
struct Warmup {
    calls: u64,
    answered: u64,
    failed: u64,
    elapsed_s: f64,
}

#[derive(Serialize)]
struct Phase<'a> {
    name: &'a str,
    #[serde(rename = "loop")]
    pace: &'static str,
    rate_per_s: Option<f64>,
    workers: usize,
    batch: usize,
    k: u32,
    radius: Option<f64>,
    mix: String,
    start_s: f64,
    elapsed_s: f64,
    due: Option<u64>,
    not_begun: u64,
    #[serde(flatten)]
    all: Calls,
    verbs: BTreeMap<&'static str, Calls>,
}

#[derive(Serialize)]
struct Total {
    elapsed_s: f64,
    #[serde(flatten)]
    all: Calls,
    verbs: BTreeMap<&'static str, Calls>,
}

/// The calls of a verb, or of all.
#[derive(Serialize)]
struct Calls {
    calls: u64,
    answered: u64,
    failed: u64,
    answered_per_s: f64,
    rows_per_s: f64,
    latency_ms: Option<Latency>,
    failures: Vec<FailureFields>,
}

#[derive(Serialize)]
struct Latency {
    p50: f64,
    p90: f64,
    p99: f64,
    p99_9: f64,
    max: f64,
    mean: f64,
}

#[derive(Serialize)]
struct FailureFields {
    kind: &'static str,
    reason: String,
    count: u64,
    first: String,
}

#[derive(Serialize)]
struct StepFields {
    phase: usize,
    start_s: f64,
    width_s: f64,
    answered: BTreeMap<&'static str, u64>,
    failed: u64,
    p50_ms: Option<f64>,
    p99_ms: Option<f64>,
    max_ms: Option<f64>,
}

impl<'a> Line<'a> {
    pub(super) fn of(outcome: &'a Outcome) -> Line<'a> {
        let total = outcome.total();
        let server = outcome.server.as_ref();
        let points = outcome.points;
        Line {
            index: &outcome.index,
            space: &outcome.space,
            face: outcome.address.face.name(),
            server: &outcome.address.server,
            prefix: outcome.address.prefix.as_deref(),
            server_version: server.map(|server| server.version.as_str()),
            durability: server.map(|server| durability_words(server.durability).0),
            machine: MachineFields {
                processor: &outcome.machine.processor,
                processors: outcome.machine.processors,
                memory_bytes: outcome.machine.memory_bytes,
                system: &outcome.machine.system,
            },
            started: utc(outcome.started),
            interrupted: outcome.is_interrupted,
            seed: outcome.seed,
            range: [outcome.range.low, outcome.range.high],
            timeout_s: outcome.timeout.as_secs_f64(),
            tag: format!("{:#x}", outcome.tag),
            points: Points {
                before: points.before,
                filled: points.filled,
                inserted: points.inserted,
                removed: points.removed,
                after: points.after,
                unsent: points.unsent,
                flush_s: outcome.flush.as_secs_f64(),
            },
            warmup: outcome.warmup.as_ref().map(|(elapsed, tally)| {
                let tally = tally.total();
                Warmup {
                    calls: tally.made(),
                    answered: tally.answered(),
                    failed: tally.failed(),
                    elapsed_s: elapsed.as_secs_f64(),
                }
            }),
            phases: outcome.phases.iter().map(Phase::of).collect(),
            total: Total {
                elapsed_s: outcome.elapsed().as_secs_f64(),
                all: Calls::of(&total.total(), outcome.elapsed()),
                verbs: verbs(&total, outcome.elapsed()),
            },
            steps: outcome.steps.iter().map(StepFields::of).collect(),
        }
    }
}

impl Phase<'_> {
    fn of(outcome: &PhaseOutcome) -> Phase<'_> {
        let (phase, total) = (&outcome.phase, outcome.tally.total());
        Phase {
            name: &phase.name,
            pace: if phase.rate.is_some() {
                "open"
            } else {
                "closed"
            },
            rate_per_s: phase.rate,
            workers: phase.workers,
            batch: phase.batch,
            k: phase.k,
            radius: phase.radius,
            mix: phase.mix.to_string(),
            start_s: outcome.start.as_secs_f64(),
            elapsed_s: outcome.elapsed.as_secs_f64(),
            due: outcome.due,
            not_begun: outcome.not_begun(total.made()),
            all: Calls::of(&total, outcome.elapsed),
            verbs: verbs(&outcome.tally, outcome.elapsed),
        }
    }
}

fn verbs(tally: &Tally, elapsed: Duration) -> BTreeMap<&'static str, Calls> {
    let called = tally.called();
    let named = called.map(|(verb, tally)| (verb.name(), Calls::of(tally, elapsed)));
    named.collect()
}

impl Calls {
    fn of(tally: &VerbTally, elapsed: Duration) -> Calls {
        let latency = tally.latencies().map(|latencies| {
            let at = |quantile| ms(latencies.value_at_quantile(quantile));
            Latency {
                p50: at(0.5),
                p90: at(0.9),
                p99: at(0.99),
                p99_9: at(0.999),
                max: ms(latencies.max()),
                mean: latencies.mean() / NANOSECONDS_PER_MS,
            }
        });
        Calls {
            calls: tally.made(),
            answered: tally.answered(),
            failed: tally.failed(),
            answered_per_s: per_second(tally.answered(), elapsed),
            rows_per_s: per_second(tally.rows, elapsed),
            latency_ms: latency,
            failures: tally.failures.iter().map(FailureFields::of).collect(),
        }
    }
}

impl FailureFields {
    fn of((cause, failures): (&Cause, &Failures)) -> FailureFields {
        FailureFields {
            kind: cause.kind.name(),
            reason: cause.reason.clone(),
            count: failures.count,
            first: failures.first.clone(),
        }
    }
}

impl StepFields {
    fn of(step: &Step) -> StepFields {
        let answered = Verb::ALL.into_iter().zip(step.answered);
        let answered = answered.filter(|(_, count)| *count > 0);
        let latency = step.latency;
        StepFields {
            phase: step.phase,
            start_s: step.start.as_secs_f64(),
            width_s: step.width.as_secs_f64(),
            answered: answered.map(|(verb, count)| (verb.name(), count)).collect(),
            failed: step.failed,
            p50_ms: latency.map(|latency| ms(latency.p50)),
            p99_ms: latency.map(|latency| ms(latency.p99)),
            max_ms: latency.map(|latency| ms(latency.max)),
        }
    }
}

const NANOSECONDS_PER_MS: f64 = 1e6;

fn ms(nanoseconds: u64) -> f64 {
    nanoseconds as f64 / NANOSECONDS_PER_MS
}
