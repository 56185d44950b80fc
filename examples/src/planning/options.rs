//! The command line of a planner.

use std::{path::PathBuf, time::Duration};

use clap::{Parser, Subcommand, ValueEnum};
use serde::{Deserialize, Serialize, de::DeserializeOwned};
use wayfold::Index;

use super::{error::PlanningError, shared_trees::job::Job};

/// Solves a motion planning problem, prints the account of the time, and draws a picture.
#[derive(Clone, Debug, Parser)]
pub struct Options {
    /// The role of this process, if it is not the one that starts the others
    #[command(subcommand)]
    pub role: Option<ProcessCommand>,
    /// The source of neighbours
    #[arg(long, value_enum, default_value_t = Source::All)]
    pub source: Source,
    /// The seed of the random states; the next run takes the next seed
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// The number of runs with each source; the table shows medians
    #[arg(long, default_value_t = 1, conflicts_with_all = ["workers", "rrt_star"])]
    pub runs: u64,
    /// The address of a running server; by default the planner starts one
    #[arg(long, value_name = "URI")]
    pub server: Option<String>,
    /// Leaves the trees of several workers on that server, to look at them
    #[arg(long, requires = "server", requires = "workers")]
    pub keep: bool,
    /// Builds two common trees by this many processes, on one server
    #[arg(long, value_parser = at_least_one, group = "several")]
    pub workers: Option<usize>,
    /// Compares 1, 2, 4 and 8 such workers, and one planner in memory, instead; no picture
    #[arg(long, group = "several")]
    pub scaling: bool,
    /// Builds one tree by RRT* from this many samples instead, and prints how its path becomes shorter
    #[arg(long, value_name = "SAMPLES", conflicts_with_all = ["several", "max_nodes"])]
    pub rrt_star: Option<usize>,
    /// The number of nodes at which it gives up
    #[arg(long, default_value_t = 1_000_000)]
    pub max_nodes: usize,
    /// Writes the figures of all runs to a file
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
}

/// The roles of a process.
#[derive(Clone, Debug, Subcommand)]
pub enum ProcessCommand {
    /// One of the workers that share two trees
    #[command(hide = true)]
    Grow {
        /// Its job in JSON
        #[arg(value_parser = from_json::<Job>)]
        job: Job,
    },
}

/// The longest wait of a worker for the server: another one may be starting in its place.
pub const TIMEOUT: Duration = Duration::from_secs(60);

/// The source of a planner's neighbours, or all.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Source {
    /// An index in this process
    Memory,
    /// An index on a server, with a copy in this process
    Shared,
    /// An index on a server, called for each search and insert
    Remote,
    /// A SIMD scan of all states
    Scan,
    /// A scalar loop over all states
    Brute,
    /// Each of these, with the same seeds
    All,
}

impl Source {
    /// Its sources, brute force first.
    pub fn sources(self) -> Vec<Source> {
        use Source::{All, Brute, Memory, Remote, Scan, Shared};
        match self {
            All => vec![Brute, Scan, Memory, Shared, Remote],
            one => vec![one],
        }
    }

    /// True if it needs a server.
    pub fn needs_server(self) -> bool {
        matches!(self, Source::Shared | Source::Remote)
    }

    /// Its sources that need a server: several workers can share them.
    pub fn server_sources(self) -> Result<Vec<Source>, PlanningError> {
        let mut sources = self.sources();
        sources.retain(|source| source.needs_server());
        match sources.is_empty() {
            true => Err(PlanningError::Unshared {
                source_name: self.name(),
            }),
            false => Ok(sources),
        }
    }

    /// Opens an index of a server: by a copy, if the source is not remote.
    pub fn open(self, uri: &str, name: &str) -> Result<Index, wayfold::Error> {
        match self {
            Source::Remote => Index::remote(uri, name).timeout(TIMEOUT).open(),
            _ => Index::shared(uri, name).timeout(TIMEOUT).open(),
        }
    }

    /// Its name in options, tables and pictures.
    pub fn name(self) -> &'static str {
        match self {
            Source::Memory => "memory",
            Source::Shared => "shared",
            Source::Remote => "remote",
            Source::Scan => "scan",
            Source::Brute => "brute",
            Source::All => "all",
        }
    }
}

/// The seeds of this many runs: consecutive numbers, and 0 after the largest.
pub fn seeds(first: u64, runs: u64) -> impl Iterator<Item = u64> {
    (0..runs.max(1)).map(move |run| first.wrapping_add(run))
}

/// A job in JSON.
pub fn from_json<J: DeserializeOwned>(text: &str) -> Result<J, serde_json::Error> {
    serde_json::from_str(text)
}

/// A number above 0.
pub fn at_least_one(text: &str) -> Result<usize, String> {
    let number = text.parse::<usize>().map_err(|error| error.to_string())?;
    match number {
        0 => Err("at least one is needed".to_owned()),
        number => Ok(number),
    }
}
