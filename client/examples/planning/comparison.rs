//! One problem, solved with several sources from the same seeds.

use std::{io, rc::Rc};

use super::{
    error::PlanningError,
    local::{BruteForce, LocalForest},
    options::{Options, Wanted},
    problem::Problem,
    remote::{Remote, ReplicaSource, ServerSource},
    rrt::{self, Account, Growth, Solution},
    server::ServerProcess,
    source::NeighborSource,
};

/// One run with one source.
pub struct Run {
    /// The source.
    pub source: Wanted,
    /// The seed.
    pub seed: u64,
    /// The nodes of both trees.
    pub nodes: usize,
    /// Where the time went.
    pub account: Account,
    /// How it came to that.
    pub growth: Vec<Growth>,
}

/// All runs of an example.
pub struct Comparison {
    /// The sources, in the order of the options.
    pub sources: Vec<Wanted>,
    /// The runs, seed by seed.
    pub runs: Vec<Run>,
    /// The solution from the first seed, which is the same with all sources.
    pub solution: Solution,
}

impl Comparison {
    /// The runs with one source.
    pub fn runs_of(&self, source: Wanted) -> impl Iterator<Item = &Run> {
        self.runs.iter().filter(move |run| run.source == source)
    }
}

/// Solves `problem` as the options say. Whatever the source, the same seed has to grow the same trees.
pub fn compare(problem: &impl Problem, options: &Options) -> Result<Comparison, PlanningError> {
    let sources = options.source.sources();
    let is_remote = |source: &Wanted| matches!(source, Wanted::Server | Wanted::Replica);
    let (mut _server, mut remote) = (None, None);
    if sources.iter().any(is_remote) {
        let uri = match &options.server {
            Some(uri) => uri.clone(),
            None => {
                let started = ServerProcess::start()?;
                let uri = started.uri().to_owned();
                _server = Some(started);
                uri
            }
        };
        remote = Some(Remote::new(&uri)?);
    }
    let (mut runs, mut shown) = (Vec::new(), None);
    for seed in options.seed..options.seed + options.runs.max(1) {
        let mut first: Option<Solution> = None;
        for &source in &sources {
            eprintln!("{}, seed {seed} ...", source.name());
            let own = || open(source, problem, remote.as_ref());
            let solution = rrt::solve(problem, [own()?, own()?], seed, options.max_nodes)?;
            runs.push(Run {
                source,
                seed,
                nodes: solution.nodes(),
                account: solution.account,
                growth: solution.growth.clone(),
            });
            match &first {
                Some(first) if first.trees != solution.trees => {
                    return Err(PlanningError::Differing {
                        first: sources[0].name().to_owned(),
                        other: source.name().to_owned(),
                        seed,
                    });
                }
                Some(_) => {}
                None => first = Some(solution),
            }
        }
        shown = shown.or(first);
    }
    let solution = shown.ok_or(PlanningError::Unsolved { nodes: 0 })?;
    Ok(Comparison {
        sources,
        runs,
        solution,
    })
}

/// An empty source; `remote` is needed for those behind a server.
pub fn open(
    source: Wanted,
    problem: &impl Problem,
    remote: Option<&Rc<Remote>>,
) -> Result<Box<dyn NeighborSource>, PlanningError> {
    let space = problem.space();
    let remote = || {
        let missing = || PlanningError::Server(io::Error::other("none is known"));
        remote.ok_or_else(missing)
    };
    Ok(match source {
        Wanted::Brute => Box::new(BruteForce::new(space)),
        Wanted::Scan => Box::new(LocalForest::scan(space)),
        Wanted::Forest | Wanted::All => Box::new(LocalForest::trees(space)),
        Wanted::Server => Box::new(ServerSource::new(remote()?, space)?),
        Wanted::Replica => Box::new(ReplicaSource::new(remote()?, space)?),
    })
}
