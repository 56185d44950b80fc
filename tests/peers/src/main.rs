//! Compares Wayfold's index with the libraries that a planner could link instead: the same points, the same queries,
//! one thread, answers checked against brute force before they are timed.

mod chart;
mod check;
mod data;
mod goals;
mod measure;
mod paper;
mod portable;
mod problem;
mod report;
mod spaces;
mod structures;

use std::{path::PathBuf, process::ExitCode, time::Duration, time::Instant};

use clap::Parser;

use check::Case;
use data::Data;
use measure::Effort;
use problem::Problem;
use report::{Op, Report};
use spaces::{SETTINGS, Setting};
use structures::Kind;

/// Measures the index and its peers and prints a table.
#[derive(Debug, Parser)]
struct Options {
    /// Fewer spaces, 50,000 points, and little but uniform data: some minutes instead of twenty
    #[arg(long)]
    quick: bool,
    /// Figures 5, 6 and 7 of the paper again, instead of the table
    #[arg(long, conflicts_with = "quick")]
    paper: bool,
    /// Measures the loss of a build that is not for this CPU alone, instead of the table (`run` fills in the program)
    #[arg(long, value_name = "PROGRAM", conflicts_with = "paper")]
    portable: Option<PathBuf>,
    /// Measures nothing, and prints the table and the goals of figures that `--json` has written; of two figures of the
    /// same the first file's counts
    #[arg(long, value_name = "FILE,...", value_delimiter = ',', conflicts_with_all = ["paper", "portable", "json"])]
    from: Vec<PathBuf>,
    /// Writes the figures to this file too
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    /// Only these spaces, by the names of the table
    #[arg(long, value_name = "NAME,...", value_delimiter = ',')]
    spaces: Vec<String>,
    /// Only these structures, by the names of the table
    #[arg(long, value_name = "NAME,...", value_delimiter = ',')]
    structures: Vec<String>,
    /// The number of repetitions of each timing; the table shows medians
    #[arg(long, default_value_t = 5, value_parser = clap::value_parser!(u8).range(1..))]
    rounds: u8,
}

/// The number of points of a case.
const POINTS: usize = 50_000;
/// The number of points of a large case.
const LARGE_POINTS: usize = 1_000_000;

/// The number of queries. It is so large that the part of a tree that they touch stays in the caches no more than a
/// planner's does.
const QUERIES: usize = 10_000;

/// Spaces that `--quick` measures with some data that is not uniform.
const QUICK_UNEVEN: [&str; 2] = ["R3", "SE3"];

fn main() -> ExitCode {
    match run(&Options::parse()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(problem) => {
            eprintln!("peers: {problem}");
            ExitCode::FAILURE
        }
    }
}

fn run(options: &Options) -> Result<(), Problem> {
    let mut report = Report::default();
    if options.paper {
        print!("{}", paper::run(usize::from(options.rounds), &mut report)?);
    } else {
        let settings = named("space", &SETTINGS, |setting| setting.name, &options.spaces)?;
        let is_meant = |setting: &Setting| setting.quick || !options.quick;
        let settings: Vec<Setting> = settings.into_iter().filter(is_meant).collect();
        if let Some(program) = &options.portable {
            print!("{}", portable::run(program, &settings, &mut report)?);
        } else {
            if options.from.is_empty() {
                compare(&settings, options, &mut report)?;
            }
            for path in &options.from {
                report.extend(report::read(path)?);
            }
            print!("{}{}", report.table(), goals::table(&report));
        }
    }
    match &options.json {
        Some(path) => report.write(path),
        None => Ok(()),
    }
}

/// The named items, or all if none is named.
fn named<T: Clone>(
    what: &'static str,
    all: &[T],
    name_of: impl Fn(&T) -> &'static str,
    names: &[String],
) -> Result<Vec<T>, Problem> {
    let find = |name: &String| {
        let found = all.iter().find(|one| name_of(one) == name);
        found.cloned().ok_or_else(|| Problem::Unknown {
            what,
            name: name.clone(),
            known: all.iter().map(&name_of).collect::<Vec<_>>().join(", "),
        })
    };
    if names.is_empty() {
        return Ok(all.to_vec());
    }
    names.iter().map(find).collect()
}

fn compare(settings: &[Setting], options: &Options, report: &mut Report) -> Result<(), Problem> {
    let mut kinds = named(
        "structure",
        &Kind::ALL,
        |kind| kind.name(),
        &options.structures,
    )?;
    if options.structures.is_empty() {
        // The paper's structures. The last two take thousands of times as long in most spaces.
        kinds.retain(|kind| !matches!(kind, Kind::Mpnn | Kind::CoverTree | Kind::Brute));
        kinds.retain(|kind| kind.is_compiled());
    }
    if !kinds.iter().all(|kind| kind.is_compiled()) {
        return Err(Problem::NoNigh);
    }
    let rounds = usize::from(options.rounds);
    let effort = Effort {
        rounds,
        searches: &[Op::Knn1, Op::Knn10, Op::Radius],
        growth_rounds: rounds.min(3),
        longest_rrt: Duration::from_secs(if options.quick { 6 } else { 30 }),
    };
    let brief = Effort {
        rounds: rounds.min(3),
        growth_rounds: 1,
        longest_rrt: Duration::ZERO,
        ..effort
    };
    let ours: Vec<Kind> = kinds
        .iter()
        .copied()
        .filter(|kind| kind.is_ours())
        .collect();
    for setting in settings {
        measure(setting, Data::Uniform, POINTS, &kinds, effort, report)?;
        if options.quick {
            if QUICK_UNEVEN.contains(&setting.name) {
                for data in [Data::Sorted, Data::Clusters] {
                    measure(setting, data, POINTS, &ours, brief, report)?;
                }
            }
            continue;
        }
        if setting.uneven {
            for data in Data::UNEVEN {
                measure(setting, data, POINTS, &kinds, brief, report)?;
            }
        }
        if setting.million {
            measure(setting, Data::Uniform, LARGE_POINTS, &kinds, brief, report)?;
        }
    }
    Ok(())
}

fn measure(
    setting: &Setting,
    data: Data,
    points: usize,
    kinds: &[Kind],
    effort: Effort,
    report: &mut Report,
) -> Result<(), Problem> {
    let begin = Instant::now();
    let space = spaces::parse(setting.text)?;
    let (points, queries) = data::generate(&space, data, points, QUERIES)?;
    // Brute force takes milliseconds per query.
    let is_slow = space.coordinates() > 14 || points.len() > POINTS;
    let checked = if is_slow { 100 } else { 500 };
    let case = Case::new(setting.name, &space, data, (&points, &queries), checked);
    measure::measure(&case, kinds, effort, report)?;
    eprintln!(
        "{} {} {}: {:.0} s",
        setting.name,
        points.len(),
        data.name(),
        begin.elapsed().as_secs_f64()
    );
    Ok(())
}

#[cfg(all(test, not(nigh)))]
mod tests {
    use super::{Options, Problem, run};
    use clap::Parser;

    #[test]
    fn a_build_without_nigh_refuses_to_measure_it() {
        let result = run(&Options::parse_from([
            "peers",
            "--structures",
            "wayfold,nigh",
        ]));
        assert!(matches!(result, Err(Problem::NoNigh)));
    }
}
