//! One problem, solved with several sources from the same seeds.

use super::{
    account::{Account, Growth},
    error::PlanningError,
    figures::{RunRecord, RunTimes},
    host::Host,
    options::{Options, Source, seeds},
    path,
    problem::Problem,
    rrt::Solution,
    rrt_star::{self, Star},
    source::TimedIndex,
};

/// The trials of a comparison.
pub struct Trials<'a> {
    /// The sources.
    pub sources: Vec<Source>,
    /// The seeds. There is one run for each seed and source.
    pub seeds: Vec<u64>,
    /// The address of a running server. If it is None, a server is started when one is needed.
    pub server: Option<&'a str>,
}

impl<'a> From<&'a Options> for Trials<'a> {
    fn from(options: &'a Options) -> Trials<'a> {
        Trials {
            sources: options.source.sources(),
            seeds: seeds(options.seed, options.runs).collect(),
            server: options.server.as_deref(),
        }
    }
}

/// The outcome of a planner, with the account of its time.
pub trait PlannerOutcome {
    /// The name of the planner.
    const PLANNER: &'static str;

    /// The name of the thing that one insert stores.
    const INSERT: &'static str;

    /// The nodes of all trees, or the milestones.
    fn nodes(&self) -> usize;

    /// The account of the time.
    fn account(&self) -> Account;

    /// The history of the account.
    fn growth(&self) -> &[Growth];

    /// The found paths.
    fn paths(&self) -> impl Iterator<Item = &[Vec<f64>]>;

    /// True if both outcomes are equal apart from their times.
    fn is_like(&self, other: &Self) -> bool;
}

/// One run with one source.
pub struct Run {
    /// The source.
    pub source: Source,
    /// The seed.
    pub seed: u64,
    /// The nodes of all trees, or the milestones.
    pub nodes: usize,
    /// The account of the time.
    pub account: Account,
    /// The history of the account.
    pub growth: Vec<Growth>,
    /// The lengths of the found paths.
    pub path_lengths: Vec<f64>,
}

/// All runs of a planner.
pub struct Comparison<R = Solution> {
    /// The sources, in the order of the trials.
    pub sources: Vec<Source>,
    /// The runs, seed by seed.
    pub runs: Vec<Run>,
    /// The solution for the first seed. It is the same with all sources.
    pub solution: R,
}

impl<R> Comparison<R> {
    /// The runs with one source.
    pub fn runs_of(&self, source: Source) -> impl Iterator<Item = &Run> {
        self.runs.iter().filter(move |run| run.source == source)
    }
}

impl<R: PlannerOutcome> Comparison<R> {
    /// The figures of all runs.
    pub fn rows(&self) -> impl Iterator<Item = RunRecord> {
        self.runs.iter().map(|run| run.row(R::PLANNER))
    }
}

impl Run {
    /// The nodes per second.
    pub fn rate(&self) -> f64 {
        self.nodes as f64 / self.account.total.as_secs_f64()
    }

    /// Its figures.
    pub fn row(&self, planner: &'static str) -> RunRecord {
        RunRecord {
            planner,
            source: self.source.name(),
            workers: 1,
            seed: self.seed,
            nodes: self.nodes as u64,
            spent: RunTimes::from(&self.account),
            checks: self.account.checks as u64,
            path_lengths: self.path_lengths.clone(),
        }
    }
}

/// A function that opens an empty index whenever a planner needs one.
pub type Open<'a> = dyn Fn() -> Result<TimedIndex, PlanningError> + 'a;

/// Solves `problem` by a planner that receives its sources and a seed. The same seed must give the same outcome with
/// every source.
pub fn compare<R: PlannerOutcome>(
    problem: &impl Problem,
    trials: &Trials<'_>,
    plan: impl Fn(&Open<'_>, u64) -> Result<R, PlanningError>,
) -> Result<Comparison<R>, PlanningError> {
    let host = host(trials)?;
    let (mut runs, mut shown) = (Vec::new(), None);
    for &seed in &trials.seeds {
        let solved = each(problem, trials, host.as_ref(), seed, &plan, R::is_like)?;
        runs.extend(solved.iter().map(|(source, solution)| {
            Run {
                source: *source,
                seed,
                nodes: solution.nodes(),
                account: solution.account(),
                growth: solution.growth().to_vec(),
                path_lengths: solution
                    .paths()
                    .map(|path| path::length(problem, path))
                    .collect(),
            }
        }));
        shown = shown.or(solved.into_iter().next());
    }
    let (_, solution) = shown.ok_or(PlanningError::Unsolved { nodes: 0 })?;
    Ok(Comparison {
        sources: trials.sources.clone(),
        runs,
        solution,
    })
}

/// Builds the tree of RRT* with each source from the same seed. The trees must be equal.
pub fn grow(
    problem: &impl Problem,
    options: &Options,
    samples: usize,
) -> Result<Vec<(Source, Star)>, PlanningError> {
    let trials = Trials::from(options);
    let host = host(&trials)?;
    let plan = |own: &Open<'_>, seed| rrt_star::grow(problem, own()?, seed, samples);
    let is_like = |one: &Star, other: &Star| one.tree == other.tree;
    each(
        problem,
        &trials,
        host.as_ref(),
        options.seed,
        &plan,
        is_like,
    )
}

/// The outcome of one seed with each source. The outcomes must be equal.
fn each<R>(
    problem: &impl Problem,
    trials: &Trials<'_>,
    host: Option<&Host>,
    seed: u64,
    plan: &impl Fn(&Open<'_>, u64) -> Result<R, PlanningError>,
    is_like: impl Fn(&R, &R) -> bool,
) -> Result<Vec<(Source, R)>, PlanningError> {
    let mut all: Vec<(Source, R)> = Vec::new();
    for &source in &trials.sources {
        eprintln!("{}, seed {seed} ...", source.name());
        let made = plan(&|| TimedIndex::new(source, problem.space(), host), seed)?;
        if let Some((first, known)) = all.first()
            && !is_like(known, &made)
        {
            return Err(PlanningError::Differing {
                first: first.name().to_owned(),
                other: source.name().to_owned(),
                seed,
            });
        }
        all.push((source, made));
    }
    Ok(all)
}

/// The server, if a source needs one.
fn host(trials: &Trials<'_>) -> Result<Option<Host>, PlanningError> {
    let is_needed = trials.sources.iter().any(|source| source.needs_server());
    is_needed.then(|| Host::new(trials.server)).transpose()
}
