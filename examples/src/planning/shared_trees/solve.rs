//! One problem, from empty indices to the path.

use wayfold::Client;

use super::{
    super::{
        comparison::{self, Open, PlannerOutcome, Run, Trials},
        error::PlanningError,
        figures::{RunRecord, RunTimes},
        options::{Options, Source, seeds},
        path::{self, Verify},
        problem::Problem,
        processes::{self, Incident, PROGRESS_MS, WORKERS, WorkersReport},
        rrt::{self, Solution},
    },
    account::Account,
    job::Job,
    meeting,
    store::Store,
    trees::SharedTrees,
};

/// The solution of a problem by several workers.
pub struct SharedSolution {
    /// The source of their neighbours.
    pub source: Source,
    /// The seed of the random states.
    pub seed: u64,
    /// The account of each worker until it learned that the trees had met.
    pub workers_report: WorkersReport<Account>,
    /// The trees.
    pub shared: SharedTrees,
    /// The path from start to goal.
    pub path: Vec<Vec<f64>>,
    /// The number of states at which the path was checked independently.
    pub checked: usize,
}

impl SharedSolution {
    /// The account of all workers together.
    pub fn sum(&self) -> Account {
        self.workers_report.accounts.iter().copied().sum()
    }

    /// The vertices that the workers inserted per second, until the server had acknowledged all.
    pub fn rate(&self) -> f64 {
        self.sum().vertices as f64 / self.workers_report.wall.as_secs_f64()
    }

    /// The account of its time.
    pub fn spent(&self) -> RunTimes {
        let (end, wall) = (self.workers_report.end(), self.workers_report.wall);
        RunTimes {
            busy_share: self.workers_report.busy_share,
            ..RunTimes::by_workers(end, wall, self.sum().times)
        }
    }

    /// Its figures.
    pub fn row(&self, problem: &impl Problem) -> RunRecord {
        let sum = self.sum();
        RunRecord {
            planner: Solution::PLANNER,
            source: self.source.name(),
            workers: self.workers_report.accounts.len(),
            seed: self.seed,
            nodes: self.shared.len() as u64,
            spent: self.spent(),
            checks: sum.checks as u64,
            path_lengths: vec![path::length(problem, &self.path)],
        }
    }
}

/// Solves `problem` on the server at `uri`, with the given number of workers.
pub async fn solve(
    problem: &impl Verify,
    uri: &str,
    options: &Options,
    workers: usize,
    source: Source,
    seed: u64,
) -> Result<SharedSolution, PlanningError> {
    let client = Client::connect(uri).await?;
    let name = format!("planning-{}", uuid::Uuid::new_v4());
    let store = Store::create(&client, &name, problem).await?;
    let max_vertices = (options.max_nodes / workers) as u64;
    let job = |number| Job {
        server: uri.to_owned(),
        store: name.clone(),
        number,
        seed,
        max_vertices,
        source,
        progress_ms: PROGRESS_MS,
        halt_at: None,
    };
    let jobs: Vec<Job> = (0..workers).map(job).collect();
    let workers_report = processes::run(&jobs, Incident::None);
    let read = read(&store).await;
    if !options.keep {
        store.delete(&client).await;
    }
    let (workers_report, (shared, path)) = (workers_report?, read?);
    Ok(SharedSolution {
        source,
        seed,
        workers_report,
        shared,
        checked: path::verify(problem, &path)?,
        path,
    })
}

/// The current trees, and the path through the vertices at which they have met.
pub async fn read(store: &Store) -> Result<(SharedTrees, Vec<Vec<f64>>), PlanningError> {
    let vertices = meeting::vertices(store.meeting()).await?;
    let shared = SharedTrees::read(store).await?;
    let unsolved = PlanningError::Unsolved {
        nodes: shared.len(),
    };
    let Some([start, goal]) = vertices else {
        return Err(unsolved);
    };
    let [from, to] = &shared.trees;
    let (Some(start), Some(goal)) = (from.node(start), to.node(goal)) else {
        return Err(PlanningError::Vertex {
            id: start,
            problem: "where the trees are said to meet, it or its like is missing",
        });
    };
    let path = rrt::path(&shared.trees, [start, goal]);
    Ok((shared, path))
}

/// Solves the problem with all numbers of workers and each source that they can share, and by one planner with indices
/// in memory, a run for each seed. The contestants take turns, so that other load on the machine affects all of them.
pub async fn compare(
    problem: &impl Verify,
    uri: &str,
    options: &Options,
) -> Result<(Vec<Run>, Vec<SharedSolution>), PlanningError> {
    let (mut alone, mut all) = (Vec::new(), Vec::new());
    for seed in seeds(options.seed, options.runs) {
        let trials = Trials {
            sources: vec![Source::Memory],
            seeds: vec![seed],
            server: None,
        };
        let plan =
            |own: &Open<'_>, seed| rrt::solve(problem, [own()?, own()?], seed, options.max_nodes);
        alone.extend(comparison::compare(problem, &trials, plan)?.runs);
        for workers in WORKERS {
            for source in options.source.server_sources()? {
                eprintln!("{workers} workers, {}, seed {seed} ...", source.name());
                all.push(solve(problem, uri, options, workers, source, seed).await?);
            }
        }
    }
    Ok((alone, all))
}
