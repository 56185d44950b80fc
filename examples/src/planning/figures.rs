//! The figures of runs as JSON: an array with one row for each run, in the same form for every planner.

use std::{fs, path::Path, time::Duration};

use serde::Serialize;

use super::{account::Account, error::PlanningError, processes::Times, report::unwritten};

/// One run of a planner.
#[derive(Clone, Debug, Serialize)]
pub struct RunRecord {
    /// The method.
    pub planner: &'static str,
    /// The source of neighbours.
    pub source: &'static str,
    /// The number of processes.
    pub workers: usize,
    /// The seed of the random states.
    pub seed: u64,
    /// The nodes of all trees, or the milestones.
    pub nodes: u64,
    /// The time of the run.
    #[serde(flatten)]
    pub spent: RunTimes,
    /// The number of states that were checked for collisions.
    pub checks: u64,
    /// The lengths of the found paths, in the metric.
    pub path_lengths: Vec<f64>,
}

/// The account of a run's time, in seconds. The parts are sums over all workers.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct RunTimes {
    /// From the start of the run to its end.
    pub total_s: f64,
    /// Searches for neighbours.
    pub search_s: f64,
    /// Inserts: the calls of one planner, and the time that workers waited for theirs.
    pub insert_s: f64,
    /// Collision checks.
    pub check_s: f64,
    /// From the end of the run until the server had acknowledged every insert.
    pub flush_s: f64,
    /// The part of the machine's processor time that was spent, by all processes; `None` if it was not measured.
    pub busy_share: Option<f64>,
}

impl From<&Account> for RunTimes {
    fn from(account: &Account) -> RunTimes {
        RunTimes {
            total_s: account.total.as_secs_f64(),
            search_s: account.neighbors.searching.as_secs_f64(),
            insert_s: account.neighbors.inserting.as_secs_f64(),
            check_s: account.checking.as_secs_f64(),
            flush_s: account.flushing.as_secs_f64(),
            busy_share: None,
        }
    }
}

impl RunTimes {
    /// The summed times of all workers in a run that ended at `end`, and whose inserts were acknowledged at `flushed`.
    pub fn by_workers(end: Duration, flushed: Duration, times: Times) -> RunTimes {
        RunTimes {
            total_s: end.as_secs_f64(),
            search_s: times.searching.as_secs_f64(),
            insert_s: times.waiting.as_secs_f64(),
            check_s: times.checking.as_secs_f64(),
            flush_s: flushed.saturating_sub(end).as_secs_f64(),
            busy_share: None,
        }
    }
}

/// Writes rows to the given file, if there is one.
pub fn write(
    rows: impl IntoIterator<Item = RunRecord>,
    file: Option<&Path>,
) -> Result<(), PlanningError> {
    let Some(file) = file else { return Ok(()) };
    let rows: Vec<RunRecord> = rows.into_iter().collect();
    let text = serde_json::to_string_pretty(&rows).map_err(|error| unwritten(file, &error))?;
    fs::write(file, text + "\n").map_err(|error| unwritten(file, &error))
}
