//! What `rigid` can be told on its command line.

use std::path::PathBuf;

use clap::{ArgGroup, Args, Parser, Subcommand};

use super::account::Account;
pub use crate::planning::options::Kind;
use crate::planning::{
    options::at_least_one,
    processes::{self, PROGRESS_MS},
};

/// What only several processes can be told.
const COOPERATION: [&str; 8] = [
    "workers",
    "source",
    "batch",
    "min_separation",
    "kill",
    "restart",
    "scaling",
    "until_solved",
];

/// Builds one roadmap by several processes, and answers several questions with it.
#[derive(Clone, Debug, Parser)]
#[command(group(ArgGroup::new("repeated").multiple(true)))]
pub struct Options {
    /// The role of this process, if it is not the one that starts the others
    #[command(subcommand)]
    pub role: Option<Role>,
    /// How many processes build the roadmap
    #[arg(long, default_value_t = 4, value_parser = at_least_one)]
    pub workers: usize,
    /// How many milestones the roadmap is to have
    #[arg(long, default_value_t = 4000)]
    pub milestones: u64,
    /// Where the first neighbours of a state come from
    #[arg(long, value_enum, default_value_t = Kind::Replica)]
    pub source: Kind,
    /// How many milestones a worker inserts in one call
    #[arg(long, default_value_t = 8, value_parser = at_least_one)]
    pub batch: usize,
    /// Leaves out states that are nearer to a milestone than this
    #[arg(long, default_value_t = 0.0)]
    pub min_separation: f64,
    /// What the random states are drawn from; the next run takes the next one
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// A server that runs already; one is started for the time of the planner unless given
    #[arg(long, value_name = "URI")]
    pub server: Option<String>,
    /// Kills one worker when it has half its share
    #[arg(long, conflicts_with_all = ["restart", "scaling"])]
    pub kill: bool,
    /// Kills the server when one worker has half its share, and starts it again: it keeps the roadmap on disk
    #[arg(long, conflicts_with_all = ["server", "scaling"])]
    pub restart: bool,
    /// Compares 1, 2, 4 and 8 workers with both sources instead; no picture
    #[arg(long, conflicts_with = "workers", group = "repeated")]
    pub scaling: bool,
    /// Ends as soon as all questions are answered, and tells how long that took, --runs times; no picture. With --scaling,
    /// by 1, 2, 4 and 8 workers
    #[arg(long, conflicts_with_all = ["kill", "restart", "batch"], group = "repeated")]
    pub until_solved: bool,
    /// Builds it by one planner instead, with every source of neighbours from the same seeds, and tells what its planning
    /// costs with each; no picture
    #[arg(long, conflicts_with_all = COOPERATION, group = "repeated")]
    pub compare: bool,
    /// How often to build each of the roadmaps that are compared; medians are told
    #[arg(long, default_value_t = 3, requires = "repeated")]
    pub runs: u64,
    /// Writes the figures to a file
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
}

/// What a process may be told to be.
#[derive(Clone, Debug, Subcommand)]
pub enum Role {
    /// One worker
    #[command(hide = true)]
    Work(Job),
    /// One that compares a roadmap with a serial replay by brute force
    #[command(hide = true)]
    Audit(Audit),
}

/// What an auditor has to know.
#[derive(Clone, Debug, Args)]
pub struct Audit {
    /// Where the server is
    #[arg(long)]
    pub server: String,
    /// The index that holds the roadmap
    #[arg(long)]
    pub index: String,
}

/// What a worker has to know.
#[derive(Clone, Debug, Args)]
pub struct Job {
    /// Where the server is
    #[arg(long)]
    pub server: String,
    /// The index that holds the roadmap
    #[arg(long)]
    pub index: String,
    /// Which worker it is
    #[arg(long)]
    pub number: usize,
    /// What all workers draw from
    #[arg(long)]
    pub seed: u64,
    /// How many milestones the roadmap is to have
    #[arg(long)]
    pub milestones: u64,
    /// Where the first neighbours come from
    #[arg(long, value_enum)]
    pub source: Kind,
    /// How many milestones it inserts in one call
    #[arg(long)]
    pub batch: usize,
    /// Leaves out states that are nearer to a milestone than this
    #[arg(long)]
    pub min_separation: f64,
    /// How often it tells its progress, at most
    #[arg(long, default_value_t = PROGRESS_MS)]
    pub progress_ms: u64,
    /// With so many milestones of its own it says so, its last calls still under way, and waits to be told to go on
    #[arg(long)]
    pub halt_at: Option<u64>,
}

impl processes::Job for Job {
    type Account = Account;

    const ROLE: &'static str = "work";

    fn number(&self) -> usize {
        self.number
    }

    fn arguments(&self) -> Vec<String> {
        let arguments = [
            ("server", self.server.clone()),
            ("index", self.index.clone()),
            ("number", self.number.to_string()),
            ("seed", self.seed.to_string()),
            ("milestones", self.milestones.to_string()),
            ("source", self.source.name().to_owned()),
            ("batch", self.batch.to_string()),
            ("min-separation", self.min_separation.to_string()),
            ("progress-ms", self.progress_ms.to_string()),
        ];
        let halt = self.halt_at.map(|own| ("halt-at", own.to_string()));
        arguments
            .into_iter()
            .chain(halt)
            .map(|(name, value)| format!("--{name}={value}"))
            .collect()
    }
}
