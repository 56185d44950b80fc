//! The whole of an example that solves one problem with every source.

use std::{path::Path, process::ExitCode};

use clap::Parser;

use super::{
    comparison::{self, Comparison},
    error::PlanningError,
    options::Options,
    path::{self, Verify},
    report, server,
};

/// How often a path is tried to be shortened before it is drawn.
const SHORTENINGS: usize = 2000;

/// Solves `problem` as the command line says, checks the path by other code, tells where the time went and has `draw` make
/// the picture `file`. By `paper` the paper's planner became faster.
pub fn run<P: Verify>(
    problem: impl FnOnce() -> P,
    paper: Option<f64>,
    file: &str,
    draw: impl FnOnce(&P, &Comparison, &[Vec<f64>], &Path) -> Result<(), PlanningError>,
) -> ExitCode {
    if let Some(ended) = server::serve_if_told() {
        return ended;
    }
    let options = Options::parse();
    let problem = problem();
    let draw = |comparison: &Comparison, shown: &[Vec<f64>]| {
        draw(&problem, comparison, shown, Path::new(file))
    };
    match solve(&problem, &options, paper, draw) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error}");
            ExitCode::FAILURE
        }
    }
}

fn solve(
    problem: &impl Verify,
    options: &Options,
    paper: Option<f64>,
    draw: impl FnOnce(&Comparison, &[Vec<f64>]) -> Result<(), PlanningError>,
) -> Result<(), PlanningError> {
    if let Some(samples) = options.rrt_star {
        return optimize(problem, options, samples);
    }
    let comparison = comparison::compare(problem, options)?;
    print!("{}", report::table(&comparison, paper));
    let path = &comparison.solution.path;
    let checked = path::verify(problem, path)?;
    println!(
        "The path of seed {} is free in {checked} states, by other code.",
        options.seed
    );
    if let Some(file) = &options.json {
        report::write_json(&comparison, file)?;
    }
    let shorter = path::shorten(problem, path.clone(), SHORTENINGS, options.seed);
    draw(&comparison, &shorter)
}

/// Grows the tree of RRT* with each source, checks its path by other code, and tells how it became shorter.
fn optimize(problem: &impl Verify, options: &Options, samples: usize) -> Result<(), PlanningError> {
    let grown = comparison::grow(problem, options, samples)?;
    print!("{}", report::progress(&grown));
    let star = grown.first().map(|(_, star)| star);
    let Some((star, goal)) = star.and_then(|star| Some((star, star.goal?))) else {
        let nodes = star.map_or(0, |star| star.tree.len());
        return Err(PlanningError::Unsolved { nodes });
    };
    let path = star.tree.branch(goal);
    let checked = path::verify(problem, &path)?;
    println!(
        "The path has {} states and the length {:.3}, and is free in {checked} states, by other code.",
        path.len(),
        path::length(problem, &path),
    );
    Ok(())
}
