//! The figures of runs as JSON: an array with a row a run, the same for every planner.

use std::{fs, path::Path};

use serde::Serialize;

use super::{account::Account, error::PlanningError, processes::Times, report::unwritten};

/// One run of a planner.
#[derive(Clone, Debug, Serialize)]
pub struct Row {
    /// The method.
    pub planner: &'static str,
    /// Where the neighbours came from.
    pub source: &'static str,
    /// How many processes worked on it.
    pub workers: usize,
    /// What the states were drawn from.
    pub seed: u64,
    /// The nodes of all trees, or the milestones.
    pub nodes: u64,
    /// The time of the run.
    #[serde(flatten)]
    pub spent: Spent,
    /// How many states were checked for collisions.
    pub checks: u64,
    /// The lengths of the paths that were found, in the metric.
    pub path_lengths: Vec<f64>,
}

/// Where the time of a run went, in seconds. The parts are sums over all workers.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct Spent {
    /// From the start of the run to its end.
    pub total_s: f64,
    /// Searches for neighbours.
    pub search_s: f64,
    /// Inserts: the calls of one planner, and the time that workers waited for theirs.
    pub insert_s: f64,
    /// Collision checks.
    pub check_s: f64,
}

impl From<&Account> for Spent {
    fn from(account: &Account) -> Spent {
        Spent {
            total_s: account.total.as_secs_f64(),
            search_s: account.neighbors.searching.as_secs_f64(),
            insert_s: account.neighbors.inserting.as_secs_f64(),
            check_s: account.checking.as_secs_f64(),
        }
    }
}

impl Spent {
    /// What workers spent together in a run of `total_s`.
    pub fn by_workers(total_s: f64, times: Times) -> Spent {
        Spent {
            total_s,
            search_s: times.searching.as_secs_f64(),
            insert_s: times.waiting.as_secs_f64(),
            check_s: times.checking.as_secs_f64(),
        }
    }
}

/// Writes rows to the file that is wanted, if one is.
pub fn write(
    rows: impl IntoIterator<Item = Row>,
    file: Option<&Path>,
) -> Result<(), PlanningError> {
    let Some(file) = file else { return Ok(()) };
    let rows: Vec<Row> = rows.into_iter().collect();
    let text = serde_json::to_string_pretty(&rows).map_err(|error| unwritten(file, &error))?;
    fs::write(file, text + "\n").map_err(|error| unwritten(file, &error))
}
