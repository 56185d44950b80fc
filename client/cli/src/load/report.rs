//! The result as a page: one file of HTML without scripts and without anything from elsewhere.

mod axis;
mod distribution;
mod escape;
mod facts;
mod file;
mod over_time;
mod svg;

use std::fmt::Write;

use super::{
    machine::utc,
    outcome::Outcome,
    record::VerbTally,
    table::{Latency, Time, pace, rate_text, route},
};
use escape::Escaped;
pub(super) use file::ReportFile;

const STYLE: &str = include_str!("report/style.css");

/// The page of a result.
pub(super) fn page(outcome: &Outcome) -> String {
    let title = format!("Load of {}", outcome.index);
    let mut page = String::new();
    // Writing into a text cannot fail.
    let _ = write_page(&mut page, outcome, &title);
    page
}

fn write_page(page: &mut String, outcome: &Outcome, title: &str) -> std::fmt::Result {
    let title = Escaped(title);
    write!(
        page,
        "<!doctype html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n\
         <meta name=\"color-scheme\" content=\"light dark\">\n\
         <title>{title}</title>\n<style>\n{STYLE}</style>\n</head>\n<body>\n<main>\n"
    )?;
    header(page, outcome)?;
    tiles(page, outcome)?;
    notes(page, outcome)?;
    section(
        page,
        "Latency over time",
        "Answered calls of all verbs. The scale is logarithmic.",
        &over_time::latency(outcome),
    )?;
    section(
        page,
        "Answers per second",
        "Answered calls by verb, one upon the other; failed calls on top of them.",
        &over_time::throughput(outcome),
    )?;
    section(
        page,
        "Latency distribution",
        "The share of answered calls that took at most this long, by verb, or by phase if there are several. Both \
         scales are logarithmic: each further nine leaves a tenth of the calls.",
        &distribution::chart(outcome),
    )?;
    facts::calls(page, outcome)?;
    facts::failures(page, outcome)?;
    facts::settings(page, outcome)?;
    write!(page, "</main>\n</body>\n</html>\n")
}

fn header(page: &mut String, outcome: &Outcome) -> std::fmt::Result {
    let (index, space) = (Escaped(&outcome.index), Escaped(&outcome.space));
    let (started, route) = (utc(outcome.started), route(outcome));
    let paces: Vec<String> = outcome
        .phases
        .iter()
        .map(|outcome| pace(&outcome.phase))
        .collect();
    let pace = match paces.as_slice() {
        [one] => one.clone(),
        several => format!("{} phases", several.len()),
    };
    write!(
        page,
        "<header>\n<p class=\"kind\">Wayfold load</p>\n<h1>{index} <span class=\"space\">{space}</span></h1>\n\
         <p class=\"lead\">{started}, {}, {}. {}</p>\n</header>\n",
        Time(outcome.elapsed()),
        Escaped(&pace),
        Escaped(&sentence(&route)),
    )
}

/// A text that begins with a capital and ends with a full stop.
fn sentence(text: &str) -> String {
    let mut letters = text.chars();
    let first = letters
        .next()
        .map(|letter| letter.to_uppercase().to_string());
    format!("{}{}.", first.unwrap_or_default(), letters.as_str())
}

fn tiles(page: &mut String, outcome: &Outcome) -> std::fmt::Result {
    let total = outcome.total().total();
    let rate = super::outcome::per_second(total.answered(), outcome.elapsed());
    let share = match total.failed() {
        0 => String::new(),
        failed => format!(
            "{:.2} % of calls",
            100.0 * failed as f64 / total.made() as f64
        ),
    };
    page.push_str("<div class=\"tiles\">\n");
    tile(page, "Answered/s", &rate_text(rate), "", "")?;
    for (name, quantile) in [
        ("p50", 0.5),
        ("p99", 0.99),
        ("p99.9", 0.999),
        ("Slowest", 1.0),
    ] {
        tile(page, name, &at(&total, quantile), "", "")?;
    }
    let class = if total.failed() > 0 { "bad" } else { "" };
    tile(
        page,
        "Failed",
        &indicatif::HumanCount(total.failed()).to_string(),
        &share,
        class,
    )?;
    page.push_str("</div>\n");
    Ok(())
}

/// A latency of answered calls, or a dash.
fn at(tally: &VerbTally, quantile: f64) -> String {
    let found = tally.latencies();
    let text = found.map(|latencies| Latency(latencies.value_at_quantile(quantile)).to_string());
    text.unwrap_or_else(|| "–".to_owned())
}

fn tile(page: &mut String, name: &str, value: &str, more: &str, class: &str) -> std::fmt::Result {
    let (number, unit) = value.split_once(' ').unwrap_or((value, ""));
    writeln!(
        page,
        "<div class=\"tile {class}\"><div class=\"name\">{name}</div><div class=\"value\">{number}<span \
         class=\"unit\">{unit}</span></div><div class=\"more\">{more}</div></div>"
    )
}

/// The notes that a reader needs before the figures.
fn notes(page: &mut String, outcome: &Outcome) -> std::fmt::Result {
    if outcome.is_interrupted {
        page.push_str("<p class=\"note\">A signal ended the run early.</p>\n");
    }
    for phase in &outcome.phases {
        let not_begun = phase.not_begun(phase.tally.total().made());
        if not_begun > 0 {
            writeln!(
                page,
                "<p class=\"note\"><b>{}:</b> {} of {} due calls never began, because all workers were busy. The \
                 latencies are lower bounds.</p>",
                Escaped(&phase.phase.name),
                indicatif::HumanCount(not_begun),
                indicatif::HumanCount(phase.due.unwrap_or_default()),
            )?;
        }
    }
    let unsent = outcome.points.unsent;
    if unsent > 0 {
        writeln!(
            page,
            "<p class=\"note\">The server did not take {unsent} writes that the shared indices had answered.</p>"
        )?;
    }
    Ok(())
}

fn section(page: &mut String, title: &str, about: &str, chart: &str) -> std::fmt::Result {
    write!(
        page,
        "<section>\n<h2>{title}</h2>\n<p class=\"about\">{about}</p>\n{chart}</section>\n"
    )
}

#[cfg(test)]
mod tests;
