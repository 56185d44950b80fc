//! A complete example, which solves one problem with every source, and with several workers.

use std::{
    path::{Path, PathBuf},
    process::ExitCode,
};

use clap::Parser;

use super::{
    comparison::{self, Comparison, Open, PlannerOutcome, Trials},
    error::{PlanningError, exit_code},
    figures,
    host::Host,
    options::{Options, ProcessCommand},
    path::{self, Verify},
    report,
    rrt::{self, Solution},
    rrt_star::Star,
    server,
    shared_trees::{
        job, report as shared_report,
        solve::{self as shared, SharedSolution},
    },
};

/// The number of attempts to shorten a path before it is drawn.
const SHORTENINGS: usize = 2000;

/// A function that draws a result, with a path to show, into a file.
pub type Draw<P, R> = fn(&P, &R, &[Vec<f64>], &Path) -> Result<(), PlanningError>;

/// The parts that differ between examples.
pub struct Example<P> {
    /// The name of its pictures.
    pub name: &'static str,
    /// The factor by which the paper's planner became faster.
    pub paper: Option<f64>,
    /// Draws the trees of one planner, and the differences of the sources.
    pub draw: Draw<P, Comparison>,
    /// Draws the trees of several workers.
    pub draw_shared: Option<Draw<P, SharedSolution>>,
    /// Draws the tree of RRT*.
    pub draw_star: Option<Draw<P, Star>>,
}

impl<P: Verify> Example<P> {
    /// Solves `problem` with the options of the command line, checks the path by independent code, prints the account
    /// of the time, and draws the picture.
    pub fn run(&self, problem: impl FnOnce() -> P) -> ExitCode {
        if let Some(ended) = server::serve_if_requested() {
            return ended;
        }
        let options = Options::parse();
        let problem = problem();
        let ended = match &options.role {
            Some(ProcessCommand::Grow { job }) => job::grow(&problem, job),
            None => self.start(&problem, &options),
        };
        exit_code(ended)
    }

    fn start(&self, problem: &P, options: &Options) -> Result<(), PlanningError> {
        let picture = self.picture(options);
        report::can_write(options.json.iter().chain(&picture).map(PathBuf::as_path))?;
        match (options.rrt_star, options.workers) {
            (Some(samples), _) => self.optimize(problem, options, samples),
            (None, Some(workers)) => self.share(problem, options, workers),
            (None, None) if options.scaling => self.scale(problem, options),
            (None, None) => self.solve(problem, options),
        }
    }

    /// The path of the picture, if one is to be drawn.
    fn picture(&self, options: &Options) -> Option<PathBuf> {
        let of = match (options.rrt_star, options.workers) {
            (Some(_), _) => self.draw_star.map(|_| "-rrt-star"),
            (None, Some(_)) => self.draw_shared.map(|_| "-shared"),
            (None, None) => (!options.scaling).then_some(""),
        };
        of.map(|of| format!("{}{of}.svg", self.name).into())
    }

    fn solve(&self, problem: &P, options: &Options) -> Result<(), PlanningError> {
        let plan =
            |own: &Open<'_>, seed| rrt::solve(problem, [own()?, own()?], seed, options.max_nodes);
        let comparison = comparison::compare(problem, &Trials::from(options), plan)?;
        print!("{}", report::table(&comparison, self.paper));
        let path = &comparison.solution.path;
        let checked = path::verify(problem, path)?;
        println!(
            "The path of seed {} is free in {checked} states, by other code.",
            options.seed
        );
        figures::write(comparison.rows(), options.json.as_deref())?;
        let shorter = path::shorten(problem, path.clone(), SHORTENINGS, options.seed)?;
        match self.picture(options) {
            Some(file) => (self.draw)(problem, &comparison, &shorter, &file),
            None => Ok(()),
        }
    }

    /// Builds the tree of RRT* with each source, checks its path by independent code, and prints how it became shorter.
    fn optimize(
        &self,
        problem: &P,
        options: &Options,
        samples: usize,
    ) -> Result<(), PlanningError> {
        let grown = comparison::grow(problem, options, samples)?;
        print!("{}", report::progress(&grown));
        let rows = grown
            .iter()
            .map(|(source, star)| star.row(*source, options.seed));
        figures::write(rows, options.json.as_deref())?;
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
        let (Some(draw), Some(file)) = (self.draw_star, self.picture(options)) else {
            return Ok(());
        };
        draw(problem, star, &path, &file)
    }

    /// Solves it with several workers.
    fn share(&self, problem: &P, options: &Options, workers: usize) -> Result<(), PlanningError> {
        let source = options.source.server_sources()?[0];
        let host = Host::new(options.server.as_deref())?;
        let seed = options.seed;
        let solved = shared::solve(problem, host.uri(), options, workers, source, seed);
        let solved = host.block_on(solved)?;
        print!("{}", shared_report::table(&solved));
        figures::write([solved.row(problem)], options.json.as_deref())?;
        let (Some(draw), Some(file)) = (self.draw_shared, self.picture(options)) else {
            return Ok(());
        };
        let shorter = path::shorten(problem, solved.path.clone(), SHORTENINGS, seed)?;
        draw(problem, &solved, &shorter, &file)
    }

    /// Compares numbers of workers.
    fn scale(&self, problem: &P, options: &Options) -> Result<(), PlanningError> {
        options.source.server_sources()?;
        let host = Host::new(options.server.as_deref())?;
        let (alone, all) = host.block_on(shared::compare(problem, host.uri(), options))?;
        print!("{}", shared_report::comparison(&alone, &all));
        let alone = alone.iter().map(|run| run.row(Solution::PLANNER));
        let rows = alone.chain(all.iter().map(|solved| solved.row(problem)));
        figures::write(rows, options.json.as_deref())
    }
}
