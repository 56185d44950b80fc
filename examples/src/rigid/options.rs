//! The command line of `rigid`.

use std::path::PathBuf;

use clap::{
    ArgGroup, Args, Parser, Subcommand, ValueEnum,
    builder::{PossibleValuesParser, TypedValueParser},
};
use serde::{Deserialize, Serialize};

use super::account::Account;
pub use crate::planning::options::Source;
use crate::planning::{
    options::{at_least_one, from_json},
    processes::{self, PROGRESS_MS},
};

/// The names of the options that apply only to several processes.
const COOPERATION: [&str; 8] = [
    "workers",
    "source",
    "max_pending",
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
    pub role: Option<ProcessCommand>,
    /// The number of processes that build the roadmap
    #[arg(long, default_value_t = 4, value_parser = at_least_one)]
    pub workers: usize,
    /// The number of milestones of the roadmap
    #[arg(long, default_value_t = 4000)]
    pub milestones: u64,
    /// The source of a state's neighbours; --scaling without --until-solved compares both
    #[arg(long, default_value = Source::Shared.name(), value_parser = server_source())]
    pub source: Source,
    /// The number of own milestones without a known place in the index's order at which a worker waits for one; a
    /// remote index, and one with --min-separation, tells each place at once
    #[arg(long, default_value_t = 32, value_parser = at_least_one)]
    pub max_pending: usize,
    /// Leaves out states that are nearer to a milestone than this
    #[arg(long, default_value_t = 0.0)]
    pub min_separation: f64,
    /// The seed of the random states; the next run takes the next seed
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// The address of a running server; by default the planner starts one
    #[arg(long, value_name = "URI")]
    pub server: Option<String>,
    /// Leaves the roadmap on that server, to look at it
    #[arg(long, requires = "server", conflicts_with_all = ["scaling", "until_solved", "compare"])]
    pub keep: bool,
    /// Kills one worker when it has half its share
    #[arg(long, conflicts_with_all = ["restart", "scaling"])]
    pub kill: bool,
    /// Kills the server when one worker has half its share, and starts it again: it keeps the roadmap on disk
    #[arg(long, conflicts_with_all = ["server", "scaling"])]
    pub restart: bool,
    /// Compares 1, 2, 4 and 8 workers with both sources instead; no picture
    #[arg(long, conflicts_with = "workers", group = "repeated")]
    pub scaling: bool,
    /// Ends as soon as all questions are answered, and prints the time, --runs times; no picture. With --scaling, by 1,
    /// 2, 4 and 8 workers
    #[arg(long, conflicts_with_all = ["kill", "restart"], group = "repeated")]
    pub until_solved: bool,
    /// Builds it by one planner instead, with every source of neighbours from the same seeds, and prints the cost of
    /// planning with each; no picture
    #[arg(long, conflicts_with_all = COOPERATION, group = "repeated")]
    pub compare: bool,
    /// The number of builds of each compared roadmap; the table shows medians
    #[arg(long, default_value_t = 3, requires = "repeated")]
    pub runs: u64,
    /// Writes the figures to a file
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
}

/// The roles of a process.
#[derive(Clone, Debug, Subcommand)]
pub enum ProcessCommand {
    /// One worker
    #[command(hide = true)]
    Work {
        /// Its job in JSON
        #[arg(value_parser = from_json::<Job>)]
        job: Job,
    },
    /// One that compares a roadmap with a serial replay by brute force
    #[command(hide = true)]
    Audit(Audit),
}

/// The parameters of an auditor.
#[derive(Clone, Debug, Args)]
pub struct Audit {
    /// The address of the server
    #[arg(long)]
    pub server: String,
    /// The index that holds the roadmap
    #[arg(long)]
    pub index: String,
}

/// Only these sources can be shared by several processes.
fn server_source() -> impl TypedValueParser<Value = Source> {
    let names = [Source::Shared, Source::Remote].map(Source::name);
    PossibleValuesParser::new(names).try_map(|name| Source::from_str(&name, false))
}

impl Options {
    /// The job of worker `number` on the roadmap in this index.
    pub fn job(&self, server: &str, index: &str, number: usize, seed: u64) -> Job {
        Job {
            server: server.to_owned(),
            index: index.to_owned(),
            number,
            seed,
            milestones: self.milestones,
            source: self.source,
            max_pending: self.max_pending,
            min_separation: self.min_separation,
            progress_ms: PROGRESS_MS,
            halt_at: None,
        }
    }
}

/// The parameters of a worker.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Job {
    /// The address of the server.
    pub server: String,
    /// The index that holds the roadmap.
    pub index: String,
    /// The number of the worker.
    pub number: usize,
    /// The seed of all workers.
    pub seed: u64,
    /// The number of milestones of the roadmap.
    pub milestones: u64,
    /// The source of the neighbours.
    pub source: Source,
    /// The number of own milestones without a known place in the order at which it waits for one.
    pub max_pending: usize,
    /// Leaves out states that are nearer to a milestone than this.
    pub min_separation: f64,
    /// The minimum interval of its progress reports.
    pub progress_ms: u64,
    /// The number of own milestones at which it reports a halt, with its last writes still under way, and waits for a
    /// line.
    pub halt_at: Option<u64>,
}

impl processes::Job for Job {
    type Account = Account;

    const ROLE: &'static str = "work";

    fn number(&self) -> usize {
        self.number
    }
}
