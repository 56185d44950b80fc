//! The result as text for people.

use std::{fmt, io, time::Duration};

use indicatif::HumanCount;

use super::{
    outcome::{Outcome, PhaseOutcome, PointCounts, Step, per_second},
    record::{Tally, VerbTally},
    settings::{Face, Phase},
};
use crate::output::{self, Column, Output};

/// Prints a result.
pub(super) fn print(outcome: &Outcome, output: &mut Output) -> io::Result<()> {
    let Outcome { index, space, .. } = outcome;
    output.text(format_args!("{index} in {space}, {}", route(outcome)))?;
    if let Some((time, tally)) = &outcome.warmup {
        let (made, time) = (HumanCount(tally.total().made()), Time(*time));
        output.text(format_args!("warm-up of {time}: {made} calls, not counted"))?;
    }
    for phase in &outcome.phases {
        output.text("")?;
        print_phase(phase, output)?;
    }
    if outcome.phases.len() > 1 {
        output.text("")?;
        output.text(format_args!("all phases, {}", Time(outcome.elapsed())))?;
        print_calls(&outcome.total(), outcome.elapsed(), output)?;
    }
    output.text("")?;
    print_points(outcome, output)?;
    if outcome.is_interrupted {
        output.text("a signal ended the run early")?;
    }
    Ok(())
}

/// The face and the address in words.
pub(super) fn route(outcome: &Outcome) -> String {
    let server = &outcome.address.server;
    match outcome.address.face {
        Face::Grpc => format!("over gRPC at {server}"),
        Face::Shared => format!(
            "as shared indices over gRPC at {server}: reads are answered in this process, and inserts travel in the \
             background"
        ),
        Face::Zenoh => format!(
            "as shared indices over Zenoh at {server}: reads are answered in this process, and inserts travel in the \
             background"
        ),
    }
}

/// The loop of a phase in words.
pub(super) fn pace(phase: &Phase) -> String {
    match phase.rate {
        Some(rate) => format!("open loop at {} calls/s", rate_text(rate)),
        None => "closed loop".to_owned(),
    }
}

fn print_phase(outcome: &PhaseOutcome, output: &mut Output) -> io::Result<()> {
    let phase = &outcome.phase;
    let workers = plural(phase.workers as u64, "worker");
    let rows = plural(phase.batch as u64, "state");
    output.text(format_args!(
        "{}: {}, {workers}, {rows} a call, {}, {}",
        phase.name,
        pace(phase),
        phase.mix,
        Time(outcome.elapsed)
    ))?;
    print_calls(&outcome.tally, outcome.elapsed, output)?;
    let made = outcome.tally.total().made();
    if let Some(due) = outcome.due {
        let not_begun = outcome.not_begun(made);
        output.text(format_args!(
            "{} calls were due; latency counts from the due time",
            HumanCount(due)
        ))?;
        if not_begun > 0 {
            output.text(format_args!(
                "{} of them never began: all workers were busy, so the latencies above are lower bounds",
                HumanCount(not_begun)
            ))?;
        }
    } else {
        output.text(
            "each worker waited for its answer before its next call; latency counts from the call",
        )?;
    }
    Ok(())
}

fn print_calls(tally: &Tally, elapsed: Duration, output: &mut Output) -> io::Result<()> {
    let total = tally.total();
    let mut rows: Vec<(&str, &VerbTally)> = tally
        .called()
        .map(|(verb, tally)| (verb.name(), tally))
        .collect();
    if rows.len() != 1 {
        rows.push(("all", &total));
    }
    let rate = |count| rate_text(per_second(count, elapsed));
    let at = |quantile: f64| {
        rows.iter().map(move |(_, tally)| match tally.latencies() {
            Some(latencies) => Latency(latencies.value_at_quantile(quantile)).to_string(),
            None => "-".to_owned(),
        })
    };
    let columns = [
        Column::new("VERB", false, rows.iter().map(|(name, _)| name)),
        Column::new(
            "CALLS",
            true,
            rows.iter().map(|(_, tally)| HumanCount(tally.made())),
        ),
        Column::new(
            "ANSWERED/S",
            true,
            rows.iter().map(|(_, tally)| rate(tally.answered())),
        ),
        Column::new(
            "ROWS/S",
            true,
            rows.iter().map(|(_, tally)| rate(tally.rows)),
        ),
        Column::new("P50", true, at(0.5)),
        Column::new("P90", true, at(0.9)),
        Column::new("P99", true, at(0.99)),
        Column::new("P99.9", true, at(0.999)),
        Column::new("MAX", true, at(1.0)),
        Column::new(
            "FAILED",
            true,
            rows.iter().map(|(_, tally)| HumanCount(tally.failed())),
        ),
    ];
    output::table(output, "  ", &columns)?;
    for (verb, tally) in tally.called() {
        for (cause, failures) in &tally.failures {
            let (kind, count) = (cause.kind.name(), HumanCount(failures.count));
            let space = if cause.reason.is_empty() { "" } else { " " };
            output.text(format_args!(
                "  {} {kind}{space}{}: {count}, the first with: {}",
                verb.name(),
                cause.reason,
                failures.first
            ))?;
        }
    }
    Ok(())
}

fn print_points(outcome: &Outcome, output: &mut Output) -> io::Result<()> {
    let PointCounts {
        before,
        filled,
        inserted,
        unsent,
        removed,
        after,
        are_kept,
    } = outcome.points;
    let count = HumanCount;
    let filled = match filled {
        0 => String::new(),
        filled => format!("{} stored first, ", count(filled)),
    };
    let end = match are_kept {
        true => "kept".to_owned(),
        false => format!("{} removed", count(removed)),
    };
    output.text(format_args!(
        "points: {} before, {filled}{} inserted, {end}{}",
        count(before),
        count(inserted),
        after.map_or(String::new(), |after| format!(", {} now", count(after)))
    ))?;
    if are_kept && after.is_none_or(|after| after > before) {
        let (index, tag) = (&outcome.index, outcome.tag);
        output.text(format_args!(
            "`wayfold scan {index} --tag {tag:#x}` lists those of this run"
        ))?;
    }
    if outcome.address.face != Face::Grpc {
        let time = Time(outcome.flush);
        output.text(format_args!(
            "the server had acknowledged all writes {time} after the last call"
        ))?;
    }
    if unsent > 0 {
        output.text(format_args!(
            "{} writes were not taken by the server after the shared index had answered them",
            count(unsent)
        ))?;
    }
    Ok(())
}

/// The line that shows a run under way.
pub(super) fn progress(phase: &Phase, now: Duration, step: &Step) -> String {
    let now = now.as_secs();
    let of = match (phase.duration, phase.calls) {
        (Some(duration), _) => format!(" of {}", Time(duration)),
        (None, Some(calls)) => format!(" of {} calls", HumanCount(calls)),
        (None, None) => String::new(),
    };
    let rate = rate_text(step.per_second(step.answered.iter().sum()));
    let latency = step.latency.map(|latency| {
        let (p50, p99) = (Latency(latency.p50), Latency(latency.p99));
        format!(", p50 {p50}, p99 {p99}")
    });
    let latency = latency.unwrap_or_default();
    let failed = match step.failed {
        0 => String::new(),
        failed => format!(", {} failed", HumanCount(failed)),
    };
    format!(
        "{}: {now} s{of}, {rate} answered/s{latency}{failed}",
        phase.name
    )
}

fn plural(count: u64, noun: &str) -> String {
    let s = if count == 1 { "" } else { "s" };
    format!("{} {noun}{s}", HumanCount(count))
}

/// A latency of nanoseconds in its unit, with three digits.
#[derive(Clone, Copy, Debug)]
pub(super) struct Latency(pub(super) u64);

impl fmt::Display for Latency {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let nanoseconds = self.0 as f64;
        // From 999.5 of a unit on, three digits show the next one.
        let (number, unit) = match self.0 {
            ..1_000 => return write!(f, "{} ns", self.0),
            1_000..999_500 => (nanoseconds / 1e3, "µs"),
            999_500..999_500_000 => (nanoseconds / 1e6, "ms"),
            _ => (nanoseconds / 1e9, "s"),
        };
        write!(f, "{} {unit}", three_digits(number))
    }
}

impl Latency {
    /// The text without zeros after the point, for round numbers.
    pub(super) fn round(self) -> String {
        let text = self.to_string();
        match text.split_once(' ') {
            Some((number, unit)) if number.contains('.') => {
                let number = number.trim_end_matches('0').trim_end_matches('.');
                format!("{number} {unit}")
            }
            _ => text,
        }
    }
}

/// A time of seconds.
#[derive(Clone, Copy, Debug)]
pub(super) struct Time(pub(super) Duration);

impl fmt::Display for Time {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let nanoseconds = u64::try_from(self.0.as_nanos()).unwrap_or(u64::MAX);
        match self.0.as_secs() {
            seconds @ 120.. => write!(f, "{} min {} s", seconds / 60, seconds % 60),
            _ if self.0.subsec_nanos() == 0 => write!(f, "{} s", self.0.as_secs()),
            _ => write!(f, "{}", Latency(nanoseconds)),
        }
    }
}

fn three_digits(number: f64) -> String {
    let digits = match number {
        ..9.995 => 2,
        ..99.95 => 1,
        _ => 0,
    };
    format!("{number:.digits$}")
}

/// A rate in whole numbers, or with digits if it is small.
pub(super) fn rate_text(rate: f64) -> String {
    match rate {
        0.0 => "0".to_owned(),
        ..99.95 => three_digits(rate),
        _ => HumanCount(rate.round() as u64).to_string(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn latencies_have_three_digits_and_a_unit() {
        for (nanoseconds, text) in [
            (0, "0 ns"),
            (999, "999 ns"),
            (1_000, "1.00 µs"),
            (12_345, "12.3 µs"),
            (999_499, "999 µs"),
            (999_500, "1.00 ms"),
            (1_234_567, "1.23 ms"),
            (99_960_000, "100 ms"),
            (999_500_000, "1.00 s"),
            (61_000_000_000, "61.0 s"),
        ] {
            assert_eq!(Latency(nanoseconds).to_string(), text);
        }
        let round = [1_000, 20_000_000, 100, 500_000_000].map(|tick| Latency(tick).round());
        assert_eq!(round, ["1 µs", "20 ms", "100 ns", "500 ms"]);
        assert_eq!(Time(Duration::from_secs(30)).to_string(), "30 s");
        assert_eq!(Time(Duration::from_millis(1500)).to_string(), "1.50 s");
        assert_eq!(Time(Duration::from_secs(301)).to_string(), "5 min 1 s");
    }

    #[test]
    fn rates_are_whole_numbers_unless_they_are_small() {
        for (rate, text) in [
            (0.0, "0"),
            (0.5, "0.50"),
            (12.34, "12.3"),
            (12_345.6, "12,346"),
        ] {
            assert_eq!(rate_text(rate), text);
        }
    }
}
