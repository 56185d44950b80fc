//! One problem, solved with several sources from the same seeds.

use std::{io, rc::Rc};

use super::{
    account::{Account, Growth},
    error::PlanningError,
    figures::{Row, RunTimes},
    local::{BruteForce, LocalForest},
    options::{Options, SourceChoice, seeds},
    path,
    problem::Problem,
    remote::{Remote, ReplicaSource, ServerSource},
    rrt::Solution,
    rrt_star::{self, Star},
    server::ServerProcess,
    source::NeighborSource,
};

/// The trials of a comparison.
pub struct Trials<'a> {
    /// The sources.
    pub sources: Vec<SourceChoice>,
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
    pub source: SourceChoice,
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
    pub sources: Vec<SourceChoice>,
    /// The runs, seed by seed.
    pub runs: Vec<Run>,
    /// The solution for the first seed. It is the same with all sources.
    pub solution: R,
}

impl<R> Comparison<R> {
    /// The runs with one source.
    pub fn runs_of(&self, source: SourceChoice) -> impl Iterator<Item = &Run> {
        self.runs.iter().filter(move |run| run.source == source)
    }
}

impl<R: PlannerOutcome> Comparison<R> {
    /// The figures of all runs.
    pub fn rows(&self) -> impl Iterator<Item = Row> {
        self.runs.iter().map(|run| Row {
            planner: R::PLANNER,
            source: run.source.name(),
            workers: 1,
            seed: run.seed,
            nodes: run.nodes as u64,
            spent: RunTimes::from(&run.account),
            checks: run.account.checks as u64,
            path_lengths: run.path_lengths.clone(),
        })
    }
}

/// A function that opens an empty source whenever a planner needs one.
pub type Open<'a> = dyn Fn() -> Result<Box<dyn NeighborSource>, PlanningError> + 'a;

/// Solves `problem` by a planner that receives its sources and a seed. The same seed must give the same outcome with
/// every source.
pub fn compare<R: PlannerOutcome>(
    problem: &impl Problem,
    trials: &Trials<'_>,
    plan: impl Fn(&Open<'_>, u64) -> Result<R, PlanningError>,
) -> Result<Comparison<R>, PlanningError> {
    let (_server, remote) = remote(trials)?;
    let (mut runs, mut shown) = (Vec::new(), None);
    for &seed in &trials.seeds {
        let solved = each(problem, trials, remote.as_ref(), seed, &plan, R::is_like)?;
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
) -> Result<Vec<(SourceChoice, Star)>, PlanningError> {
    let trials = Trials::from(options);
    let (_server, remote) = remote(&trials)?;
    let plan = |own: &Open<'_>, seed| rrt_star::grow(problem, own()?, seed, samples);
    let is_like = |one: &Star, other: &Star| one.tree == other.tree;
    each(
        problem,
        &trials,
        remote.as_ref(),
        options.seed,
        &plan,
        is_like,
    )
}

/// The outcome of one seed with each source. The outcomes must be equal.
fn each<R>(
    problem: &impl Problem,
    trials: &Trials<'_>,
    remote: Option<&Rc<Remote>>,
    seed: u64,
    plan: &impl Fn(&Open<'_>, u64) -> Result<R, PlanningError>,
    is_like: impl Fn(&R, &R) -> bool,
) -> Result<Vec<(SourceChoice, R)>, PlanningError> {
    let mut all: Vec<(SourceChoice, R)> = Vec::new();
    for &source in &trials.sources {
        eprintln!("{}, seed {seed} ...", source.name());
        let made = plan(&|| open(source, problem, remote), seed)?;
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

/// The server for the sources, with its threads. It is started unless one runs already.
fn remote(
    trials: &Trials<'_>,
) -> Result<(Option<ServerProcess>, Option<Rc<Remote>>), PlanningError> {
    let is_remote =
        |source: &SourceChoice| matches!(source, SourceChoice::Server | SourceChoice::Replica);
    if !trials.sources.iter().any(is_remote) {
        return Ok((None, None));
    }
    if let Some(uri) = trials.server {
        return Ok((None, Some(Remote::new(uri)?)));
    }
    let started = ServerProcess::start()?;
    let remote = Remote::new(started.uri())?;
    Ok((Some(started), Some(remote)))
}

/// Opens an empty source. Sources behind a server need `remote`.
pub fn open(
    source: SourceChoice,
    problem: &impl Problem,
    remote: Option<&Rc<Remote>>,
) -> Result<Box<dyn NeighborSource>, PlanningError> {
    let space = problem.space();
    let remote = || {
        let missing = || PlanningError::Server(io::Error::other("none is known"));
        remote.ok_or_else(missing)
    };
    Ok(match source {
        SourceChoice::Brute => Box::new(BruteForce::new(space)),
        SourceChoice::Scan => Box::new(LocalForest::scan(space)),
        SourceChoice::Forest | SourceChoice::All => Box::new(LocalForest::trees(space)),
        SourceChoice::Server => Box::new(ServerSource::new(remote()?, space)?),
        SourceChoice::Replica => Box::new(ReplicaSource::new(remote()?, space)?),
    })
}
