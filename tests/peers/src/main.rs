//! Wayfold's index beside the libraries that a planner could link instead: the same points, the same queries, one
//! thread, answers checked against brute force before they are timed.

mod chart;
mod check;
mod data;
mod measure;
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
use report::Report;
use spaces::{SETTINGS, Setting};
use structures::Kind;

/// Measures the index beside its peers and prints a table.
#[derive(Debug, Parser)]
struct Options {
    /// Fewer spaces, 50,000 points, uniform data: some minutes instead of an hour
    #[arg(long)]
    quick: bool,
    /// Writes the figures to this file too
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    /// Only these spaces, by the names of the table
    #[arg(long, value_name = "NAME,...", value_delimiter = ',')]
    spaces: Vec<String>,
    /// Only these structures, by the names of the table
    #[arg(long, value_name = "NAME,...", value_delimiter = ',')]
    structures: Vec<String>,
    /// How often each timing is repeated; the table shows medians
    #[arg(long, default_value_t = 5, value_parser = clap::value_parser!(u8).range(1..))]
    rounds: u8,
}

/// Points of a case, unless it is one of the large.
const POINTS: usize = 50_000;

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
    let settings = named("space", &SETTINGS, |setting| setting.name, &options.spaces)?;
    let kinds = named(
        "structure",
        &Kind::ALL,
        |kind| kind.name(),
        &options.structures,
    )?;
    let mut report = Report::default();
    for setting in &settings {
        if options.quick && !setting.quick {
            continue;
        }
        measure(setting, Data::Uniform, POINTS, &kinds, options, &mut report)?;
    }
    print!("{}", report.table());
    match &options.json {
        Some(path) => report.write(path),
        None => Ok(()),
    }
}

/// Those that are named, or all if none is.
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

fn measure(
    setting: &Setting,
    data: Data,
    points: usize,
    kinds: &[Kind],
    options: &Options,
    report: &mut Report,
) -> Result<(), Problem> {
    let begin = Instant::now();
    let space = spaces::parse(setting.text)?;
    let (points, queries) = data::generate(&space, data, points, 10_000)?;
    // Brute force takes milliseconds for each.
    let checked = if space.coordinates() > 14 || points.len() > POINTS {
        100
    } else {
        500
    };
    let case = Case::new(setting.name, &space, data, (&points, &queries), checked);
    let effort = Effort {
        rounds: usize::from(options.rounds),
        growth: true,
        most: Duration::from_secs(if options.quick { 5 } else { 60 }),
    };
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
