//! The job of a worker process.

use clap::Args;

use super::{
    super::{
        error::PlanningError,
        options::Source,
        problem::Problem,
        processes::{self, PROGRESS_MS, Reporter},
    },
    account::Account,
    store::Layout,
    worker::Worker,
};

/// The parameters of a worker, apart from the problem.
#[derive(Clone, Debug, Args)]
pub struct Job {
    /// The address of the server
    #[arg(long)]
    pub server: String,
    /// The name of the store that holds the trees
    #[arg(long)]
    pub store: String,
    /// The way in which the store separates the trees
    #[arg(long, value_enum)]
    pub layout: Layout,
    /// The number of the worker
    #[arg(long)]
    pub number: usize,
    /// The seed of all workers
    #[arg(long)]
    pub seed: u64,
    /// The number of own vertices at which it gives up
    #[arg(long)]
    pub max_vertices: u64,
    /// The source of its neighbours
    #[arg(long, value_enum)]
    pub source: Source,
    /// The minimum interval of its progress reports
    #[arg(long, default_value_t = PROGRESS_MS)]
    pub progress_ms: u64,
    /// The number of own vertices at which it reports a halt, with its last inserts still under way, and waits for a
    /// line
    #[arg(long)]
    pub halt_at: Option<u64>,
}

impl processes::Job for Job {
    type Account = Account;

    const ROLE: &'static str = "grow";

    fn number(&self) -> usize {
        self.number
    }

    fn arguments(&self) -> Vec<String> {
        let arguments = [
            ("server", self.server.clone()),
            ("store", self.store.clone()),
            ("layout", self.layout.name().to_owned()),
            ("number", self.number.to_string()),
            ("seed", self.seed.to_string()),
            ("max-vertices", self.max_vertices.to_string()),
            ("source", self.source.name().to_owned()),
            ("progress-ms", self.progress_ms.to_string()),
        ];
        let halt = self.halt_at.map(|own| ("halt-at", own.to_string()));
        let all = arguments.into_iter().chain(halt);
        all.map(|(name, value)| format!("--{name}={value}"))
            .collect()
    }
}

/// The role of a worker.
pub fn grow(problem: &impl Problem, job: &Job) -> Result<(), PlanningError> {
    let trees = (job.server.as_str(), job.store.as_str());
    let (layout, source) = (job.layout, job.source);
    let mut worker = Worker::open(problem, trees, layout, source, job.number, job.seed)?;
    let mut reporter = Reporter::ready(job, job.progress_ms, job.halt_at)?;
    worker.grow(job.max_vertices, |account| reporter.progress(account))?;
    reporter.done(&worker.account())
}
