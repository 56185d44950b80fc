//! The tables of a report: calls, failures, settings, machine.

use std::fmt::{Result, Write};

use indicatif::{HumanBytes, HumanCount};

use super::{at, escape::Escaped};
use crate::{
    load::{
        outcome::{Outcome, PhaseOutcome, per_second},
        record::VerbTally,
        settings::Phase,
        table::{Time, pace, rate_text},
    },
    verb::durability_words,
};

const QUANTILES: [f64; 5] = [0.5, 0.9, 0.99, 0.999, 1.0];

/// The calls of each phase by verb.
pub(super) fn calls(page: &mut String, outcome: &Outcome) -> Result {
    page.push_str(
        "<section>\n<h2>Calls</h2>\n<p class=\"about\">In an open loop the latency counts from the time at which a call \
         was due, in a closed one from the call. Rows are states or ids.</p>\n<div class=\"wide\"><table>\n<thead><tr><th>\
         Phase</th><th>Verb</th><th class=\"n\">Calls</th><th class=\"n\">Answered/s</th><th class=\"n\">Rows/s</th><th \
         class=\"n\">p50</th><th class=\"n\">p90</th><th class=\"n\">p99</th><th class=\"n\">p99.9</th><th \
         class=\"n\">Slowest</th><th class=\"n\">Failed</th></tr></thead>\n",
    );
    for phase in &outcome.phases {
        phase_rows(page, phase)?;
    }
    page.push_str("</table></div>\n</section>\n");
    Ok(())
}

fn phase_rows(page: &mut String, outcome: &PhaseOutcome) -> Result {
    page.push_str("<tbody>\n");
    let total = outcome.tally.total();
    let mut rows: Vec<(&str, &VerbTally)> = outcome
        .tally
        .called()
        .map(|(verb, tally)| (verb.name(), tally))
        .collect();
    if rows.len() != 1 {
        rows.push(("all", &total));
    }
    for (i, (name, tally)) in rows.iter().enumerate() {
        let phase = if i == 0 {
            outcome.phase.name.as_str()
        } else {
            ""
        };
        let rate = |count| rate_text(per_second(count, outcome.elapsed));
        let class = if *name == "all" { "all" } else { "" };
        write!(
            page,
            "<tr class=\"{class}\"><td>{}</td><td><span class=\"key {name}\"></span>{name}</td><td class=\"n\">{}</td><td \
             class=\"n\">{}</td><td class=\"n\">{}</td>",
            Escaped(phase),
            HumanCount(tally.made()),
            rate(tally.answered()),
            rate(tally.rows),
        )?;
        for quantile in QUANTILES {
            write!(page, "<td class=\"n\">{}</td>", at(tally, quantile))?;
        }
        let class = if tally.failed() > 0 { "n bad" } else { "n" };
        writeln!(
            page,
            "<td class=\"{class}\">{}</td></tr>",
            HumanCount(tally.failed())
        )?;
    }
    page.push_str("</tbody>\n");
    Ok(())
}

/// The causes of failures, if there were any.
pub(super) fn failures(page: &mut String, outcome: &Outcome) -> Result {
    if outcome.total().total().failed() == 0 {
        return Ok(());
    }
    page.push_str(
        "<section>\n<h2>Failures</h2>\n<div class=\"wide\"><table>\n<thead><tr><th>Phase</th><th>Verb</th><th>Kind</th>\
         <th>Reason</th><th class=\"n\">Calls</th><th>The first message</th></tr></thead>\n<tbody>\n",
    );
    for phase in &outcome.phases {
        for (verb, tally) in phase.tally.called() {
            for (cause, failures) in &tally.failures {
                writeln!(
                    page,
                    "<tr><td>{}</td><td>{}</td><td>{}</td><td>{}</td><td class=\"n bad\">{}</td><td class=\"message\">{}</td></tr>",
                    Escaped(&phase.phase.name),
                    verb.name(),
                    cause.kind.name(),
                    Escaped(&cause.reason),
                    HumanCount(failures.count),
                    Escaped(&failures.first),
                )?;
            }
        }
    }
    page.push_str("</tbody></table></div>\n</section>\n");
    Ok(())
}

/// Everything that a reader needs to repeat the run.
pub(super) fn settings(page: &mut String, outcome: &Outcome) -> Result {
    page.push_str("<div class=\"columns\">\n<section>\n<h2>Settings</h2>\n");
    for outcome in &outcome.phases {
        list(page, &phase(&outcome.phase))?;
    }
    list(page, &run(outcome))?;
    page.push_str("</section>\n<section>\n<h2>Machine</h2>\n");
    list(page, &machine(outcome))?;
    page.push_str("</section>\n</div>\n");
    Ok(())
}

fn list(page: &mut String, facts: &[(&str, String)]) -> Result {
    page.push_str("<dl>\n");
    for (name, value) in facts {
        writeln!(page, "<dt>{name}</dt><dd>{}</dd>", Escaped(value))?;
    }
    page.push_str("</dl>\n");
    Ok(())
}

fn phase(phase: &Phase) -> Vec<(&'static str, String)> {
    let mut facts = vec![
        ("Phase", phase.name.clone()),
        ("Calls", pace(phase)),
        ("Workers", phase.workers.to_string()),
        ("Mix", phase.mix.to_string()),
        ("States a call", phase.batch.to_string()),
        ("k", phase.k.to_string()),
    ];
    facts.extend(
        phase
            .radius
            .map(|radius| ("Radius", format!("{radius:.6}"))),
    );
    facts.extend(
        phase
            .duration
            .map(|time| ("Duration", Time(time).to_string())),
    );
    facts.extend(
        phase
            .calls
            .map(|calls| ("Number of calls", HumanCount(calls).to_string())),
    );
    facts
}

fn run(outcome: &Outcome) -> Vec<(&'static str, String)> {
    let points = outcome.points;
    let end = match points.are_kept {
        true => "kept".to_owned(),
        false => format!("{} removed", HumanCount(points.removed)),
    };
    let mut facts = vec![
        (
            "Points",
            format!(
                "{} before, {} stored first, {} inserted, {end}{}",
                HumanCount(points.before),
                HumanCount(points.filled),
                HumanCount(points.inserted),
                points.after.map_or(String::new(), |after| format!(
                    ", {} now",
                    HumanCount(after)
                ))
            ),
        ),
        ("Seed", outcome.seed.to_string()),
        (
            "Real coordinates",
            format!("{} to {}", outcome.range.low, outcome.range.high),
        ),
        ("Timeout", Time(outcome.timeout).to_string()),
    ];
    if let Some((time, tally)) = &outcome.warmup {
        let made = HumanCount(tally.total().made());
        facts.push((
            "Warm-up",
            format!("{made} calls in {}, not counted", Time(*time)),
        ));
    }
    facts
}

fn machine(outcome: &Outcome) -> Vec<(&'static str, String)> {
    let machine = &outcome.machine;
    let mut facts = vec![("Callers", machine.system.clone())];
    if !machine.processor.is_empty() {
        facts.push(("Processor", machine.processor.clone()));
    }
    facts.push(("Processors", machine.processors.to_string()));
    facts.extend(
        machine
            .memory_bytes
            .map(|bytes| ("Memory", HumanBytes(bytes).to_string())),
    );
    facts.push(("Program", format!("wayfold {}", env!("CARGO_PKG_VERSION"))));
    facts.push(("Face", outcome.address.face.name().to_owned()));
    facts.push(("Server", outcome.address.server.clone()));
    facts.extend(
        outcome
            .address
            .prefix
            .iter()
            .map(|prefix| ("Prefix", prefix.clone())),
    );
    if let Some(server) = &outcome.server {
        facts.push(("Server version", server.version.clone()));
        facts.push((
            "Durability",
            durability_words(server.durability).0.to_owned(),
        ));
    }
    facts
}
