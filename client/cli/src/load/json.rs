//! The result as one JSON object. The help text of the command documents the fields.

use std::time::Duration;

use serde_json::{Map, Value, json};

use super::{
    machine::utc,
    mix::Verb,
    outcome::{Outcome, PhaseOutcome, Step, per_second},
    record::{Tally, VerbTally},
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
  points: before, filled, inserted, removed, after: numbers of points, after null if unknown;
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

/// The object of a result.
pub(super) fn object(outcome: &Outcome) -> Value {
    let (server, machine) = (outcome.server.as_ref(), &outcome.machine);
    let (points, elapsed) = (outcome.points, outcome.elapsed());
    let warmup = outcome.warmup.as_ref().map(|(elapsed, tally)| {
        let tally = tally.total();
        json!({
            "calls": tally.made(),
            "answered": tally.answered(),
            "failed": tally.failed(),
            "elapsed_s": elapsed.as_secs_f64(),
        })
    });
    json!({
        "index": outcome.index,
        "space": outcome.space,
        "face": outcome.address.face.name(),
        "server": outcome.address.server,
        "prefix": outcome.address.prefix,
        "server_version": server.map(|server| &server.version),
        "durability": server.map(|server| durability_words(server.durability).0),
        "machine": {
            "processor": machine.processor,
            "processors": machine.processors,
            "memory_bytes": machine.memory_bytes,
            "system": machine.system,
        },
        "started": utc(outcome.started),
        "interrupted": outcome.is_interrupted,
        "seed": outcome.seed,
        "range": [outcome.range.low, outcome.range.high],
        "timeout_s": outcome.timeout.as_secs_f64(),
        "tag": format!("{:#x}", outcome.tag),
        "points": {
            "before": points.before,
            "filled": points.filled,
            "inserted": points.inserted,
            "removed": points.removed,
            "after": points.after,
            "unsent": points.unsent,
            "flush_s": outcome.flush.as_secs_f64(),
        },
        "warmup": warmup,
        "phases": outcome.phases.iter().map(phase).collect::<Value>(),
        "total": with_calls(json!({ "elapsed_s": elapsed.as_secs_f64() }), &outcome.total(), elapsed),
        "steps": outcome.steps.iter().map(step).collect::<Value>(),
    })
}

fn phase(outcome: &PhaseOutcome) -> Value {
    let phase = &outcome.phase;
    let own = json!({
        "name": phase.name,
        "loop": if phase.rate.is_some() { "open" } else { "closed" },
        "rate_per_s": phase.rate,
        "workers": phase.workers,
        "batch": phase.batch,
        "k": phase.k,
        "radius": phase.radius,
        "mix": phase.mix.to_string(),
        "start_s": outcome.start.as_secs_f64(),
        "elapsed_s": outcome.elapsed.as_secs_f64(),
        "due": outcome.due,
        "not_begun": outcome.not_begun(outcome.tally.total().made()),
    });
    with_calls(own, &outcome.tally, outcome.elapsed)
}

/// An object with the fields of all calls, and those of each verb.
fn with_calls(mut object: Value, tally: &Tally, elapsed: Duration) -> Value {
    let verbs = tally.called();
    let verbs = verbs.map(|(verb, tally)| (verb.name().to_owned(), calls(tally, elapsed)));
    object["verbs"] = verbs.collect::<Map<_, _>>().into();
    if let (Value::Object(own), Value::Object(all)) = (&mut object, calls(&tally.total(), elapsed))
    {
        own.extend(all);
    }
    object
}

/// The calls of a verb, or of all.
fn calls(tally: &VerbTally, elapsed: Duration) -> Value {
    let latency = tally.latencies().map(|latencies| {
        let at = |quantile| ms(latencies.value_at_quantile(quantile));
        json!({
            "p50": at(0.5),
            "p90": at(0.9),
            "p99": at(0.99),
            "p99_9": at(0.999),
            "max": ms(latencies.max()),
            "mean": latencies.mean() / NANOSECONDS_PER_MS,
        })
    });
    let failures = tally.failures.iter().map(|(cause, failures)| {
        json!({
            "kind": cause.kind.name(),
            "reason": cause.reason,
            "count": failures.count,
            "first": failures.first,
        })
    });
    json!({
        "calls": tally.made(),
        "answered": tally.answered(),
        "failed": tally.failed(),
        "answered_per_s": per_second(tally.answered(), elapsed),
        "rows_per_s": per_second(tally.rows, elapsed),
        "latency_ms": latency,
        "failures": failures.collect::<Value>(),
    })
}

fn step(step: &Step) -> Value {
    let answered = Verb::ALL.into_iter().zip(step.answered);
    let answered = answered.filter(|(_, count)| *count > 0);
    let answered = answered.map(|(verb, count)| (verb.name().to_owned(), count.into()));
    json!({
        "phase": step.phase,
        "start_s": step.start.as_secs_f64(),
        "width_s": step.width.as_secs_f64(),
        "answered": answered.collect::<Map<_, _>>(),
        "failed": step.failed,
        "p50_ms": step.latency.map(|latency| ms(latency.p50)),
        "p99_ms": step.latency.map(|latency| ms(latency.p99)),
        "max_ms": step.latency.map(|latency| ms(latency.max)),
    })
}

const NANOSECONDS_PER_MS: f64 = 1e6;

fn ms(nanoseconds: u64) -> f64 {
    nanoseconds as f64 / NANOSECONDS_PER_MS
}
