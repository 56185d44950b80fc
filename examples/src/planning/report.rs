//! The account of the time, as one table.

use std::{
    fmt::Write,
    fs::{self, OpenOptions},
    io,
    path::Path,
    time::Duration,
};

use super::{
    comparison::{Comparison, PlannerOutcome, Run},
    error::PlanningError,
    options::Source,
    processes::Times,
    rrt_star::{Progress, Star},
};

/// Medians over the runs with one source.
struct Line {
    source: Source,
    nodes: f64,
    total: f64,
    /// The time until the server had acknowledged every insert.
    flushed: f64,
    searching: f64,
    inserting: f64,
    checking: f64,
    rest: f64,
    /// The time of one search and of one insert call, in microseconds.
    search_us: f64,
    insert_us: f64,
}

impl Line {
    fn of<R>(comparison: &Comparison<R>, source: Source) -> Line {
        let middle = |of: fn(&Run) -> f64| median(comparison.runs_of(source).map(of));
        Line {
            source,
            nodes: middle(|run| run.nodes as f64),
            total: middle(|run| run.account.total.as_secs_f64()),
            flushed: middle(|run| (run.account.total + run.account.flushing).as_secs_f64()),
            searching: middle(|run| run.account.neighbors.searching.as_secs_f64()),
            inserting: middle(|run| run.account.neighbors.inserting.as_secs_f64()),
            checking: middle(|run| run.account.checking.as_secs_f64()),
            rest: middle(|run| run.account.rest().as_secs_f64()),
            search_us: middle(|run| {
                let used = run.account.neighbors;
                each_us(used.searching, used.searches)
            }),
            insert_us: middle(|run| {
                let used = run.account.neighbors;
                each_us(used.inserting, used.inserts)
            }),
        }
    }

    fn all<R>(comparison: &Comparison<R>) -> Vec<Line> {
        let sources = comparison.sources.iter();
        sources
            .map(|&source| Line::of(comparison, source))
            .collect()
    }

    fn neighbors(&self) -> f64 {
        self.searching + self.inserting
    }

    fn percent(&self, part: f64) -> f64 {
        100.0 * part / self.total
    }

    /// Its speedups over another source: of the neighbour searches, and of the whole run.
    fn faster_than(&self, other: &Line) -> [f64; 2] {
        [
            other.neighbors() / self.neighbors(),
            other.total / self.total,
        ]
    }
}

fn each_us(time: Duration, calls: usize) -> f64 {
    time.as_secs_f64() * 1e6 / calls.max(1) as f64
}

/// The median; NaN if there are no values.
pub fn median(numbers: impl IntoIterator<Item = f64>) -> f64 {
    let mut numbers: Vec<f64> = numbers.into_iter().collect();
    numbers.sort_by(f64::total_cmp);
    let middle = numbers.len() / 2;
    match numbers.len() {
        0 => f64::NAN,
        count if count % 2 == 1 => numbers[middle],
        _ => f64::midpoint(numbers[middle - 1], numbers[middle]),
    }
}

/// Of the times of workers, the median shares of searches, checks and inserts, in percent.
pub fn shares(times: impl Iterator<Item = Times> + Clone) -> [f64; 3] {
    let parts: [fn(Times) -> Duration; 3] = [|of| of.searching, |of| of.checking, |of| of.waiting];
    parts.map(|part| median(times.clone().map(|of| of.percent(part(of)))))
}

/// The table. `paper` is the speedup of the paper's planner by the trees of the paper's library, if the paper gives it.
pub fn table<R: PlannerOutcome>(comparison: &Comparison<R>, paper: Option<f64>) -> String {
    let lines = Line::all(comparison);
    let runs = comparison.runs.len() / lines.len().max(1);
    let mut text = format!(
        "{:<8}{:>8}{:>9}{:>9}{:>9}{:>9}{:>9}{:>9}{:>8}{:>8}{:>10}{:>10}{:>16}{:>16}\n{:<8}{:>8}{:>9}{:>9}{:>9}{:>9}{:>9}{:>9}{:>8}{:>8}{:>10}{:>10}{:>8}{:>8}{:>8}{:>8}\n",
        "",
        "nodes",
        "total",
        "flushed",
        "search",
        "insert",
        "checks",
        "rest",
        "share",
        "share",
        "a search",
        "an insert",
        "than brute",
        "than the scan",
        "",
        "",
        "s",
        "s",
        "s",
        "s",
        "s",
        "s",
        "s+i, %",
        "chk, %",
        "µs",
        "µs",
        "s+i",
        "total",
        "s+i",
        "total",
    );
    for line in &lines {
        let _ = write!(
            text,
            "{:<8}{:>8}{:>9.3}{:>9.3}{:>9.3}{:>9.3}{:>9.3}{:>9.3}{:>8.1}{:>8.1}{:>10.2}{:>10.2}",
            line.source.name(),
            line.nodes,
            line.total,
            line.flushed,
            line.searching,
            line.inserting,
            line.checking,
            line.rest,
            line.percent(line.neighbors()),
            line.percent(line.checking),
            line.search_us,
            line.insert_us,
        );
        for baseline in BASELINES {
            let [search, total] = match of(&lines, baseline) {
                Some(baseline) => line.faster_than(baseline).map(ratio),
                None => [String::new(), String::new()],
            };
            let _ = write!(text, "{search:>8}{total:>8}");
        }
        text.truncate(text.trim_end().len());
        text.push('\n');
    }
    let _ = writeln!(
        text,
        "Medians of {runs} run{}. An insert is one call for {}. Faster: by what with neighbours and in all, than scalar brute force, and than a SIMD scan. Flushed: until the server had acknowledged every insert.",
        if runs == 1 { "" } else { "s" },
        R::INSERT,
    );
    if let Some(paper) = paper {
        let _ = writeln!(
            text,
            "The paper's planner became {paper}× faster in total (its Fig. 8, its machine, its brute force)."
        );
    }
    network(&lines, &mut text);
    text
}

/// The source with which the others are compared.
const BASELINES: [Source; 2] = [Source::Brute, Source::Scan];

fn of(lines: &[Line], source: Source) -> Option<&Line> {
    lines.iter().find(|line| line.source == source)
}

fn ratio(ratio: f64) -> String {
    match ratio {
        ..0.1 => format!("{ratio:.3}×"),
        ..10.0 => format!("{ratio:.2}×"),
        _ => format!("{ratio:.0}×"),
    }
}

/// Prints the cost of the network, if the same index was used with and without it.
fn network(lines: &[Line], text: &mut String) {
    let Some(memory) = of(lines, Source::Memory) else {
        return;
    };
    let remote = [Source::Remote, Source::Shared].into_iter();
    for line in remote.filter_map(|source| of(lines, source)) {
        let search = (line.search_us - memory.search_us).max(0.0);
        let insert = (line.insert_us - memory.insert_us).max(0.0);
        let eaten = line.neighbors() - memory.neighbors();
        let _ = writeln!(
            text,
            "The {} adds {search:.0} µs to a search and {insert:.0} µs to an insert: {eaten:.2} s, {:.0} % of its total.",
            line.source.name(),
            line.percent(eaten),
        );
    }
}

/// The improvement of RRT*'s path, and its time with each source.
pub fn progress(grown: &[(Source, Star)]) -> String {
    let mut text = format!("{:>9} {:>9} {:>9}", "samples", "nodes", "length");
    for (source, _) in grown {
        let _ = write!(text, " {:>17}", format!("{}, s", source.name()));
    }
    text.push('\n');
    let rows: Vec<Vec<&Progress>> = grown
        .iter()
        .map(|(_, star)| star.progress.iter().collect())
        .collect();
    for at in 0..rows.first().map_or(0, Vec::len) {
        let first = rows[0][at];
        let cost = match first.cost.is_finite() {
            true => format!("{:.3}", first.cost),
            false => "none".to_owned(),
        };
        let _ = write!(text, "{:>9} {:>9} {cost:>9}", first.samples, first.nodes);
        for of in rows.iter().map(|row| row[at]) {
            let total = of.total.as_secs_f64();
            let share = 100.0 * of.neighbors.time().as_secs_f64() / total;
            let _ = write!(text, " {total:>9.2} ({share:>3.0} %)");
        }
        text.push('\n');
    }
    for (source, star) in grown.iter().filter(|(source, _)| source.needs_server()) {
        let (name, flushing) = (source.name(), star.account.flushing.as_secs_f64());
        let _ = writeln!(
            text,
            "{name}: the server had acknowledged every insert {flushing:.3} s later."
        );
    }
    text + "In brackets: the share of searches and inserts. Lengths are of the same tree, whatever the source.\n"
}

/// Opens the files that a run will write, so that an unwritable file is reported before the work. Their content stays
/// until then, and a file that did not exist is removed again.
pub fn can_write<'a>(paths: impl IntoIterator<Item = &'a Path>) -> Result<(), PlanningError> {
    for path in paths {
        let created = OpenOptions::new().append(true).create_new(true).open(path);
        let opened = match created {
            Ok(_) => fs::remove_file(path),
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {
                OpenOptions::new().append(true).open(path).map(drop)
            }
            Err(error) => Err(error),
        };
        opened.map_err(|error| unwritten(path, &error))?;
    }
    Ok(())
}

/// The error of a file that cannot be written.
pub fn unwritten(path: &Path, problem: &impl ToString) -> PlanningError {
    PlanningError::File {
        path: path.to_owned(),
        problem: problem.to_string(),
    }
}
