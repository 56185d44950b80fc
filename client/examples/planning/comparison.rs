//! One problem, solved with several sources from the same seeds.

use std::{io, rc::Rc};

use super::{
    error::PlanningError,
    local::{BruteForce, LocalForest},
    options::{Options, Wanted, seeds},
    problem::Problem,
    remote::{Remote, ReplicaSource, ServerSource},
    rrt::{self, Account, Growth, Solution},
    rrt_star::{self, Star},
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
    let (_server, remote) = remote(options)?;
    let (mut runs, mut shown) = (Vec::new(), None);
    for seed in seeds(options.seed, options.runs) {
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

/// Grows the tree of RRT* with each source, from the same seed. It has to be the same tree.
pub fn grow(
    problem: &impl Problem,
    options: &Options,
    samples: usize,
) -> Result<Vec<(Wanted, Star)>, PlanningError> {
    let (_server, remote) = remote(options)?;
    let mut grown: Vec<(Wanted, Star)> = Vec::new();
    for source in options.source.sources() {
        eprintln!("{}, seed {} ...", source.name(), options.seed);
        let own = open(source, problem, remote.as_ref())?;
        let star = rrt_star::grow(problem, own, options.seed, samples)?;
        if let Some((first, known)) = grown.first()
            && known.tree != star.tree
        {
            return Err(PlanningError::Differing {
                first: first.name().to_owned(),
                other: source.name().to_owned(),
                seed: options.seed,
            });
        }
        grown.push((source, star));
    }
    Ok(grown)
}

/// What the options' sources need of a server: one that is started for them, unless one runs already, and its threads.
fn remote(options: &Options) -> Result<(Option<ServerProcess>, Option<Rc<Remote>>), PlanningError> {
    let is_remote = |source: &Wanted| matches!(source, Wanted::Server | Wanted::Replica);
    if !options.source.sources().iter().any(is_remote) {
        return Ok((None, None));
    }
    if let Some(uri) = &options.server {
        return Ok((None, Some(Remote::new(uri)?)));
    }
    let started = ServerProcess::start()?;
    let remote = Remote::new(started.uri())?;
    Ok((Some(started), Some(remote)))
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
