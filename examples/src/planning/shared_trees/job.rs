//! The job of a worker process.

use serde::{Deserialize, Serialize};

use super::{
    super::{
        error::PlanningError,
        options::Source,
        problem::Problem,
        processes::{self, Reporter},
    },
    account::Account,
    worker::Worker,
};

/// The parameters of a worker, apart from the problem.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Job {
    /// The address of the server.
    pub server: String,
    /// The name of the store that holds the trees.
    pub store: String,
    /// The number of the worker.
    pub number: usize,
    /// The seed of all workers.
    pub seed: u64,
    /// The number of own vertices at which it gives up.
    pub max_vertices: u64,
    /// The source of its neighbours.
    pub source: Source,
    /// The minimum interval of its progress reports.
    pub progress_ms: u64,
    /// The number of own vertices at which it reports a halt, with its last inserts still under way, and waits for a
    /// line.
    pub halt_at: Option<u64>,
}

impl processes::Job for Job {
    type Account = Account;

    const ROLE: &'static str = "grow";

    fn number(&self) -> usize {
        self.number
    }
}

/// The role of a worker.
pub fn grow(problem: &impl Problem, job: &Job) -> Result<(), PlanningError> {
    let trees = (job.server.as_str(), job.store.as_str());
    let mut worker = Worker::open(problem, trees, job.source, job.number, job.seed)?;
    let mut reporter = Reporter::ready(job, job.progress_ms, job.halt_at)?;
    worker.grow(job.max_vertices, |account| reporter.progress(account))?;
    reporter.done(&worker.account())
}
