//! The tables.

use std::{fmt::Write, time::Duration};

use super::{
    super::{
        comparison::Run,
        options::Source,
        processes::WORKERS,
        report::{median, shares},
    },
    account::Account,
    solve::SharedSolution,
};

/// The account of one solution, worker by worker.
pub fn table(solved: &SharedSolution) -> String {
    let mut text = format!(
        "{:<10} {:>8} {:>9} {:>10} {:>8} {:>9} {:>8} {:>8}\n",
        "", "samples", "vertices", "checks", "wall s", "search %", "check %", "insert %"
    );
    let mut row = |name: &str, wall: Duration, account: &Account| {
        let times = account.times;
        let _ = writeln!(
            text,
            "{name:<10} {:>8} {:>9} {:>10} {:>8.3} {:>9.1} {:>8.1} {:>8.1}",
            account.samples,
            account.vertices,
            account.checks,
            wall.as_secs_f64(),
            times.percent(times.searching),
            times.percent(times.checking),
            times.percent(times.waiting),
        );
    };
    for (number, account) in solved.workers_report.accounts.iter().enumerate() {
        row(&format!("worker {number}"), account.times.total, account);
    }
    row("all", solved.workers_report.wall, &solved.sum());
    let spent = solved.spent();
    let _ = writeln!(
        text,
        "The indices were {}. {:.0} vertices/s; {:.3} s until all knew that the trees had met, {:.3} s until the server had \
         acknowledged every insert.\n\
         Both trees are read from the server, with {} vertices that have their parents.\n\
         The path of seed {} has {} states, and is free in {} states, by other code.",
        solved.source.name(),
        solved.rate(),
        spent.total_s,
        solved.workers_report.wall.as_secs_f64(),
        solved.shared.len(),
        solved.seed,
        solved.path.len(),
        solved.checked,
    );
    text
}

/// Medians by source and number of workers, and their speedup over one worker and over one planner with indices in
/// memory, `alone`, with the same seed.
pub fn comparison(alone: &[Run], all: &[SharedSolution]) -> String {
    let mut text = format!(
        "{:<8} {:>8} {:>9} {:>26} {:>11} {:>9} {:>8} {:>8} {:>13} {:>10} {:>10}\n",
        "source",
        "workers",
        "vertices",
        "to solution, s (min..max)",
        "vertices/s",
        "search %",
        "check %",
        "insert %",
        "to one worker",
        "vertices/s",
        "to memory"
    );
    for source in [Source::Shared, Source::Remote] {
        for workers in WORKERS {
            let of = |source, workers| {
                let is_of_row = move |one: &&SharedSolution| {
                    one.source == source && one.workers_report.accounts.len() == workers
                };
                all.iter().filter(is_of_row)
            };
            let wall = |one: &SharedSolution| one.workers_report.wall.as_secs_f64();
            let mut walls: Vec<f64> = of(source, workers).map(wall).collect();
            walls.sort_by(f64::total_cmp);
            let [Some(least), Some(most)] = [walls.first(), walls.last()] else {
                continue;
            };
            let span = format!(
                "{:.2} ({least:.2}..{most:.2})",
                median(walls.iter().copied())
            );
            let times = of(source, workers).map(|one| one.sum().times);
            let [search, check, wait] = shares(times);
            // The ratios are taken seed by seed, because the runs of one seed are close in time.
            let pairs = || of(source, workers).zip(of(source, 1));
            let _ = writeln!(
                text,
                "{:<8} {workers:>8} {:>9.0} {span:>26} {:>11.0} {search:>9.1} {check:>8.1} {wait:>8.1} {:>12.2}× {:>9.2}× {:>9.2}×",
                source.name(),
                median(of(source, workers).map(|one| one.sum().vertices as f64)),
                median(of(source, workers).map(SharedSolution::rate)),
                median(pairs().map(|(many, one)| wall(one) / wall(many))),
                median(pairs().map(|(many, one)| many.rate() / one.rate())),
                median(
                    of(source, workers)
                        .zip(alone)
                        .map(|(many, one)| many.rate() / one.rate())
                ),
            );
        }
    }
    let _ = writeln!(
        text,
        "One planner with indices in memory: {:.0} vertices in {:.2} s, {:.0} a second.",
        median(alone.iter().map(|run| run.nodes as f64)),
        median(alone.iter().map(|run| run.account.total.as_secs_f64())),
        median(alone.iter().map(Run::rate)),
    );
    text + "Shares are of the workers' time. Other workers draw other states, and so grow other trees until these meet.\n"
}
