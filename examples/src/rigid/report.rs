//! The tables.

use std::{fmt::Write, time::Duration};

use super::{
    account::Account,
    build::{Answer, Built},
    options::Source,
};
use crate::planning::{
    comparison::PlannerOutcome,
    figures::{RunRecord, RunTimes},
    prm_star::AnsweredRoadmap,
    processes::WORKERS,
    report::{median, shares},
};

impl Built {
    /// The account of all workers together.
    fn sum(&self) -> Account {
        self.workers_report.accounts.iter().copied().sum()
    }

    /// The milestones that the workers made per second.
    pub fn rate(&self) -> f64 {
        self.sum().milestones as f64 / self.workers_report.wall.as_secs_f64()
    }

    /// Its figures, for the workers without the questions.
    pub fn row(&self) -> RunRecord {
        let sum = self.sum();
        RunRecord {
            planner: AnsweredRoadmap::PLANNER,
            source: self.source.name(),
            workers: self.workers,
            seed: self.seed,
            nodes: sum.milestones,
            spent: RunTimes::by_workers(
                self.workers_report.end(),
                self.workers_report.wall,
                sum.times,
            ),
            checks: sum.checks,
            path_lengths: self.paths.iter().map(|path| path.length).collect(),
        }
    }
}

/// The account of one roadmap, worker by worker.
pub fn table(built: &Built) -> String {
    let mut text = String::new();
    let mut row = |name: &str, wall: Duration, account: &Account| {
        let times = account.times;
        let _ = writeln!(
            text,
            "{name:<10} {:>9} {:>10} {:>9} {:>9} {:>8.2} {:>9.1} {:>8.1} {:>8.1} {:>10.0}",
            account.samples,
            account.milestones,
            account.edges,
            account.meanwhile,
            wall.as_secs_f64(),
            times.percent(times.searching),
            times.percent(times.checking),
            times.percent(times.waiting),
            account.milestones as f64 / wall.as_secs_f64().max(f64::MIN_POSITIVE),
        );
    };
    for (number, account) in built.workers_report.accounts.iter().enumerate() {
        row(&format!("worker {number}"), account.times.total, account);
    }
    row("all", built.workers_report.wall, &built.sum());
    let head = format!(
        "{:<10} {:>9} {:>10} {:>9} {:>9} {:>8} {:>9} {:>8} {:>8} {:>10}\n",
        "",
        "samples",
        "milestones",
        "edges",
        "meanwhile",
        "wall s",
        "search %",
        "check %",
        "wait %",
        "per second",
    );
    let mut text = head + &text;
    if let Some((worker, at)) = built.workers_report.killed {
        let _ = writeln!(
            text,
            "Worker {worker} was killed after {:.2} s.",
            at.as_secs_f64()
        );
    }
    if let Some((killed, listened)) = built.workers_report.restarted {
        let _ = writeln!(
            text,
            "The server was killed after {:.2} s and listened again after {:.2} s; no worker reported a milestone for \
             {:.2} s.",
            killed.as_secs_f64(),
            listened.as_secs_f64(),
            built.workers_report.longest_pause().as_secs_f64(),
        );
    }
    let _ = writeln!(
        text,
        "{} pending milestones were completed in {:.3} s; the roadmap has {} milestones and {} edges.",
        built.adopted,
        built.adopting.as_secs_f64(),
        built.roadmap.len(),
        built.roadmap.edge_count(),
    );
    if let Some((found, required)) = built.separation {
        let _ = writeln!(
            text,
            "The two nearest of the workers' milestones are {found:.3} apart; at least {required} was required."
        );
    }
    text += &answers(&built.paths);
    let _ = writeln!(
        text,
        "All of them were found in {:.3} s.",
        built.asking.as_secs_f64()
    );
    text
}

/// The properties of the paths.
pub fn answers(paths: &[Answer]) -> String {
    let mut text = String::new();
    for answer in paths {
        let _ = writeln!(
            text,
            "The path {} has {} milestones and the length {:.2}, and is free in {} states, by other code.",
            answer.name,
            answer.states.len(),
            answer.length,
            answer.checked,
        );
    }
    text
}

/// Medians by source and number of workers, and their ratios to one worker and to the other source in the same run.
pub fn comparison(all: &[Built]) -> String {
    let of = |source, workers| {
        let is_of_row = move |one: &&Built| one.source == source && one.workers == workers;
        all.iter().filter(is_of_row)
    };
    let mut text = format!(
        "{:<10} {:>8} {:>10} {:>8} {:>10} {:>9} {:>8} {:>8} {:>13} {:>10}\n",
        "source",
        "workers",
        "milestones",
        "wall s",
        "per second",
        "search %",
        "check %",
        "wait %",
        "to one worker",
        "to server",
    );
    for source in [Source::Shared, Source::Remote] {
        for workers in WORKERS {
            let times = of(source, workers).map(|one| one.sum().times);
            let [search, check, wait] = shares(times);
            // The ratios are taken seed by seed: runs of one seed are close in time, and with one worker they draw the
            // same states.
            let ratio = |other_source, other_workers| {
                let pairs = of(source, workers).zip(of(other_source, other_workers));
                median(pairs.map(|(one, other)| one.rate() / other.rate()))
            };
            let _ = writeln!(
                text,
                "{:<10} {workers:>8} {:>10.0} {:>8.2} {:>10.0} {search:>9.1} {check:>8.1} {wait:>8.1} {:>13.2} {:>10.2}",
                source.name(),
                median(of(source, workers).map(|one| one.sum().milestones as f64)),
                median(of(source, workers).map(|one| one.workers_report.wall.as_secs_f64())),
                median(of(source, workers).map(Built::rate)),
                ratio(source, 1),
                ratio(Source::Remote, workers),
            );
        }
    }
    text
}
