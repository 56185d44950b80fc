//! Searches of many states in the shapes of scipy's `KDTree`.

use std::{num::NonZero, panic, sync::Arc, thread};

use pyo3::prelude::*;
use wayfold::{Error, Index, Neighbor, Search};

use crate::{error::invalid, search::k_of};

/// The ranks of the neighbours that a query returns.
pub(crate) enum Ranks {
    /// The `k` nearest.
    First(usize),
    /// The neighbours of these ranks, from 1.
    Each(Vec<usize>),
}

impl Ranks {
    pub(crate) fn of(k: &Bound<'_, PyAny>) -> PyResult<Ranks> {
        let py = k.py();
        let one = |k: i64| k_of(py, k).map(|k| k as usize);
        if let Ok(k) = k.extract() {
            return Ok(Ranks::First(one(k)?));
        }
        let ranks = k.try_iter()?.map(|k| one(k?.extract()?));
        let ranks = ranks.collect::<PyResult<Vec<_>>>()?;
        match ranks.is_empty() {
            true => Err(invalid(py, "k: an empty list")),
            false => Ok(Ranks::Each(ranks)),
        }
    }

    /// The number of nearest neighbours to search for.
    pub(crate) fn k(&self) -> u32 {
        let k = match self {
            Ranks::First(k) => *k,
            Ranks::Each(ranks) => ranks.iter().copied().max().unwrap_or(1),
        };
        // Each of them was a u32.
        u32::try_from(k).unwrap_or(u32::MAX)
    }

    /// The number of neighbours that a state has in the answer.
    pub(crate) fn columns(&self) -> usize {
        match self {
            Ranks::First(k) => *k,
            Ranks::Each(ranks) => ranks.len(),
        }
    }

    /// The distances and the ids of the neighbours of states, one row after the other.
    pub(crate) fn table<'a>(
        &self,
        rows: impl ExactSizeIterator<Item = &'a [Neighbor]>,
    ) -> (Vec<f64>, Vec<i64>) {
        let cells = rows.len() * self.columns();
        let (mut distances, mut ids) = (Vec::with_capacity(cells), Vec::with_capacity(cells));
        let mut push = |neighbor: Option<&Neighbor>| {
            distances.push(neighbor.map_or(f64::INFINITY, |neighbor| neighbor.distance));
            ids.push(neighbor.map_or(-1, |neighbor| neighbor.id as i64));
        };
        for row in rows {
            match self {
                Ranks::First(k) => {
                    row.iter().for_each(|neighbor| push(Some(neighbor)));
                    (row.len()..*k).for_each(|_| push(None));
                }
                Ranks::Each(ranks) => ranks.iter().for_each(|rank| push(row.get(rank - 1))),
            }
        }
        (distances, ids)
    }
}

/// The search of a query. The bound itself is left out by [`within`].
pub(crate) fn search(py: Python<'_>, k: u32, eps: f64, bound: f64) -> PyResult<Search> {
    check_number(py, "distance_upper_bound", bound)?;
    check_eps(py, eps)?;
    Ok(Search::k(k).radius(bound).epsilon(eps))
}

/// Leaves out neighbours at exactly the bound, as scipy does.
pub(crate) fn within(neighbors: &[Neighbor], bound: f64) -> &[Neighbor] {
    let at = neighbors.partition_point(|neighbor| neighbor.distance < bound);
    &neighbors[..at]
}

pub(crate) fn check_eps(py: Python<'_>, eps: f64) -> PyResult<()> {
    match eps.is_finite() {
        true => check_number(py, "eps", eps),
        false => Err(invalid(py, &format!("eps: {eps}; it is finite"))),
    }
}

/// Refuses NaN and negative numbers.
pub(crate) fn check_number(py: Python<'_>, field: &str, number: f64) -> PyResult<()> {
    match number >= 0.0 {
        true => Ok(()),
        false => Err(invalid(py, &format!("{field}: {number}; it is at least 0"))),
    }
}

/// The number of threads of an argument `workers`.
pub(crate) fn workers(py: Python<'_>, workers: i64) -> PyResult<usize> {
    match workers {
        -1 => Ok(thread::available_parallelism().map_or(1, NonZero::get)),
        1.. => Ok(usize::try_from(workers).unwrap_or(usize::MAX)),
        _ => Err(invalid(
            py,
            &format!("workers: {workers}; it is -1, for all processors, or at least 1"),
        )),
    }
}

/// Searches for the neighbours of many rows by several threads, each of which sees one state of the index.
pub(crate) fn search_many(
    index: &Index,
    rows: &[f64],
    search: &Search,
    workers: usize,
) -> Result<Vec<Vec<Neighbor>>, Error> {
    let width = index.space().coordinates();
    let count = rows.len() / width;
    let part = |rows: &[f64]| index.search_many(rows.chunks_exact(width), search);
    if workers.min(count) <= 1 {
        return part(rows);
    }
    let rows_each = count.div_ceil(workers);
    thread::scope(|scope| {
        let threads: Vec<_> = rows
            .chunks(rows_each * width)
            .map(|rows| thread::Builder::new().spawn_scoped(scope, move || part(rows)))
            .collect();
        let mut found = Vec::with_capacity(count);
        for (number, thread) in threads.into_iter().enumerate() {
            let thread = thread.map_err(|error| Error::Thread {
                source: Arc::new(error),
            })?;
            let answer = thread
                .join()
                .unwrap_or_else(|why| panic::resume_unwind(why));
            found.extend(answer.map_err(|error| later_row(error, number * rows_each))?);
        }
        Ok(found)
    })
}

/// The error of a part whose first row is row `first` of the call.
fn later_row(error: Error, first: usize) -> Error {
    match error {
        Error::State { row, error } => Error::State {
            row: row + first,
            error,
        },
        error => error,
    }
}
