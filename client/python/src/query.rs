//! Searches of many states in the shapes of scipy's `KDTree`.

use std::{num::NonZero, ops::Range, panic, sync::Arc, thread};

use numpy::{PyArrayDyn, ndarray::ArrayD};
use pyo3::{
    IntoPyObjectExt,
    exceptions::{PyMemoryError, PyTypeError},
    prelude::*,
    sync::PyOnceLock,
    types::{PyList, PyTuple},
};
use wayfold::{Error, Neighbor, Search, SearchResult};

use crate::{
    error::invalid,
    index::{Form, Index},
    points::column,
    rows::Rows,
    search::{k_of, saturated},
};

/// The rows whose neighbours are held at once where only their numbers are returned. A remote index sends as many at once.
const BLOCK_ROWS: usize = 1_000;

/// The arguments of `query` besides the states and `k`.
pub(crate) struct Nearest {
    pub(crate) eps: f64,
    /// Neighbours at this distance or farther are left out.
    pub(crate) bound: f64,
    pub(crate) workers: usize,
}

/// The arguments of `query_ball_point` besides the states and the radii.
pub(crate) struct Ball {
    pub(crate) eps: f64,
    pub(crate) workers: usize,
    /// Without it, the ids of several states are sorted and those of one are not.
    pub(crate) is_sorted: Option<bool>,
    /// Only the numbers of ids are returned.
    pub(crate) is_length: bool,
}

/// The distances and the ids of the nearest neighbours of states.
pub(crate) fn nearest<'py>(
    index: &Index,
    x: &Bound<'py, PyAny>,
    k: Option<&Bound<'py, PyAny>>,
    &Nearest {
        eps,
        bound,
        workers,
    }: &Nearest,
) -> PyResult<Bound<'py, PyTuple>> {
    let py = x.py();
    let Rows { numbers, mut shape } = index.rows(x)?;
    let ranks = k.map_or(Ok(Ranks::First(1)), Ranks::of)?;
    let search = search(py, ranks.k(), eps, bound)?;
    if shape.is_empty() {
        let found = index.call(py, |index| index.search(&numbers[..], &search))?;
        let neighbors = within(&found.neighbors, bound);
        return match ranks {
            Ranks::First(1) => {
                let first = neighbors.first();
                let distance = first.map_or(f64::INFINITY, |first| first.distance);
                let id = first.map_or(-1, |first| first.id as i64);
                (distance, id).into_pyobject(py)
            }
            ranks => {
                let (distances, ids) =
                    Table::with_room(1, &ranks)?.fill(&ranks, [neighbors].into_iter());
                (column(py, distances), column(py, ids)).into_pyobject(py)
            }
        };
    }
    // Before the search, which might be long.
    let rows = numbers.len() / index.index.space().coordinates();
    let table = Table::with_room(rows, &ranks)?;
    let (distances, ids) = index.call(py, |index| {
        let found = search_many(index, &numbers, &search, workers)?;
        Ok(table.fill(
            &ranks,
            found.iter().map(|found| within(&found.neighbors, bound)),
        ))
    })?;
    if !matches!(ranks, Ranks::First(1)) {
        shape.push(ranks.columns());
    }
    (array(py, &shape, distances)?, array(py, &shape, ids)?).into_pyobject(py)
}

/// The ids of all points within the radius of each state.
pub(crate) fn ball<'py>(
    index: &Index,
    x: &Bound<'py, PyAny>,
    r: &Bound<'py, PyAny>,
    &Ball {
        eps,
        workers,
        is_sorted,
        is_length,
    }: &Ball,
) -> PyResult<Bound<'py, PyAny>> {
    let py = x.py();
    let Rows { numbers, shape } = index.rows(x)?;
    check_eps(py, eps)?;
    let radii = radii(r, &shape)?;
    for &radius in &radii {
        check_number(py, "r", radius)?;
    }
    let is_sorted = is_sorted.unwrap_or(!shape.is_empty());
    let is_remote = index.form == Form::Remote;
    let width = index.index.space().coordinates();
    let answer = |index: &wayfold::Index, part: Range<usize>, rows: &[f64]| {
        let within = |radius: f64| Search::within(radius).epsilon(eps);
        let rows = rows.chunks_exact(width);
        match radii[..] {
            [radius] => index.search_many(rows, &within(radius)),
            [] => Ok(Vec::new()),
            _ if is_remote => {
                // It takes one search a call: that of the greatest radius.
                let greatest = radii[part.clone()].iter().copied().fold(0.0, f64::max);
                let mut found = index.search_many(rows, &within(greatest));
                for (found, &radius) in found.iter_mut().flatten().zip(&radii[part]) {
                    let neighbors = &mut found.neighbors;
                    neighbors.truncate(neighbors.partition_point(|near| near.distance <= radius));
                }
                found
            }
            _ => {
                let searches: Vec<Search> = radii[part].iter().map(|&it| within(it)).collect();
                index.search_each(rows, &searches)
            }
        }
    };
    if is_length {
        let lengths = index.call(py, |index| {
            by_workers(index, &numbers, workers, |index, part, rows| {
                lengths(index, part, rows, answer)
            })
        })?;
        return match lengths[..] {
            [length] if shape.is_empty() => length.into_bound_py_any(py),
            _ => Ok(array(py, &shape, lengths)?.into_any()),
        };
    }
    let ids: Vec<Vec<u64>> = index.call(py, |index| {
        by_workers(index, &numbers, workers, |index, part, rows| {
            let found = answer(index, part, rows)?.into_iter().map(|found| {
                let mut ids: Vec<u64> = found.ids().collect();
                if is_sorted {
                    ids.sort_unstable();
                }
                ids
            });
            Ok(found.collect())
        })
    })?;
    let mut lists = ids.into_iter();
    if shape.is_empty() {
        return lists.next().unwrap_or_default().into_bound_py_any(py);
    }
    static LISTS: PyOnceLock<Py<PyAny>> = PyOnceLock::new();
    let array_of_lists = LISTS.import(py, "wayfold._states", "array_of_lists")?;
    array_of_lists.call1((PyList::new(py, lists)?, shape))
}

/// The numbers of the neighbours of rows. The neighbours of all rows at once may be more than memory can hold.
fn lengths(
    index: &wayfold::Index,
    part: Range<usize>,
    rows: &[f64],
    answer: impl Fn(&wayfold::Index, Range<usize>, &[f64]) -> Result<Vec<SearchResult>, Error>,
) -> Result<Vec<i64>, Error> {
    let width = index.space().coordinates();
    let mut lengths = Vec::with_capacity(part.len());
    for rows in rows.chunks(BLOCK_ROWS * width) {
        let first = part.start + lengths.len();
        let found = answer(index, first..first + rows.len() / width, rows);
        let found = found.map_err(|error| later_row(error, lengths.len()))?;
        lengths.extend(found.iter().map(|found| found.neighbors.len() as i64));
    }
    Ok(lengths)
}

/// The ranks of the neighbours that a query returns.
enum Ranks {
    /// The `k` nearest.
    First(usize),
    /// The neighbours of these ranks, from 1.
    Each(Vec<usize>),
}

impl Ranks {
    fn of(k: &Bound<'_, PyAny>) -> PyResult<Ranks> {
        let py = k.py();
        let one = |k: &Bound<'_, PyAny>| k_of(k).map(|k| k as usize);
        let error = match one(k) {
            Err(error) if error.is_instance_of::<PyTypeError>(py) => error,
            one => return one.map(Ranks::First),
        };
        let ranks = k.try_iter().map_err(|_| error)?;
        let ranks = ranks.map(|k| one(&k?));
        let ranks = ranks.collect::<PyResult<Vec<_>>>()?;
        match ranks.is_empty() {
            true => Err(invalid(py, "k: an empty list")),
            false => Ok(Ranks::Each(ranks)),
        }
    }

    /// The number of nearest neighbours to search for.
    fn k(&self) -> u32 {
        let k = match self {
            Ranks::First(k) => *k,
            Ranks::Each(ranks) => ranks.iter().copied().max().unwrap_or(1),
        };
        // Each of them was a u32.
        u32::try_from(k).unwrap_or(u32::MAX)
    }

    /// The number of neighbours that a state has in the answer.
    fn columns(&self) -> usize {
        match self {
            Ranks::First(k) => *k,
            Ranks::Each(ranks) => ranks.len(),
        }
    }
}

/// The distances and the ids of the neighbours of states, one row after the other.
struct Table {
    distances: Vec<f64>,
    ids: Vec<i64>,
}

impl Table {
    /// An empty table with room for all neighbours. A `MemoryError` if there is no memory for it.
    fn with_room(rows: usize, ranks: &Ranks) -> PyResult<Table> {
        let columns = ranks.columns();
        let (mut distances, mut ids) = (Vec::new(), Vec::new());
        let has_room = rows.checked_mul(columns).is_some_and(|cells| {
            distances.try_reserve_exact(cells).is_ok() && ids.try_reserve_exact(cells).is_ok()
        });
        match has_room {
            true => Ok(Table { distances, ids }),
            false => Err(PyMemoryError::new_err(format!(
                "k: an answer of {rows} rows of {columns} neighbours is more than memory can hold"
            ))),
        }
    }

    fn fill<'a>(
        self,
        ranks: &Ranks,
        rows: impl Iterator<Item = &'a [Neighbor]>,
    ) -> (Vec<f64>, Vec<i64>) {
        let Table {
            mut distances,
            mut ids,
        } = self;
        let mut push = |neighbor: Option<&Neighbor>| {
            distances.push(neighbor.map_or(f64::INFINITY, |neighbor| neighbor.distance));
            ids.push(neighbor.map_or(-1, |neighbor| neighbor.id as i64));
        };
        for row in rows {
            match ranks {
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
fn search(py: Python<'_>, k: u32, eps: f64, bound: f64) -> PyResult<Search> {
    check_number(py, "distance_upper_bound", bound)?;
    check_eps(py, eps)?;
    Ok(Search::k(k).radius(bound).epsilon(eps))
}

/// Leaves out neighbours at exactly the bound, as scipy does.
fn within(neighbors: &[Neighbor], bound: f64) -> &[Neighbor] {
    let at = neighbors.partition_point(|neighbor| neighbor.distance < bound);
    &neighbors[..at]
}

fn check_eps(py: Python<'_>, eps: f64) -> PyResult<()> {
    match eps.is_finite() {
        true => check_number(py, "eps", eps),
        false => Err(invalid(py, &format!("eps: {eps}; it is finite"))),
    }
}

/// Refuses NaN and negative numbers.
fn check_number(py: Python<'_>, field: &str, number: f64) -> PyResult<()> {
    match number >= 0.0 {
        true => Ok(()),
        false => Err(invalid(py, &format!("{field}: {number}; it is at least 0"))),
    }
}

/// The number of threads of an argument `workers`, at most one for each processor.
pub(crate) fn workers_of(workers: &Bound<'_, PyAny>) -> PyResult<usize> {
    let processors = thread::available_parallelism().map_or(1, NonZero::get);
    match saturated(workers)? {
        -1 => Ok(processors),
        number @ 1.. => Ok(usize::try_from(number).map_or(processors, |n| n.min(processors))),
        _ => Err(invalid(
            workers.py(),
            &format!("workers: {workers}; it is -1, for all processors, or at least 1"),
        )),
    }
}

/// Searches for the neighbours of many rows by several threads.
fn search_many(
    index: &wayfold::Index,
    rows: &[f64],
    search: &Search,
    workers: usize,
) -> Result<Vec<SearchResult>, Error> {
    by_workers(index, rows, workers, |index, _, rows| {
        index.search_many(rows.chunks_exact(index.space().coordinates()), search)
    })
}

/// Several threads answer many rows. `answer` gets the numbers of the rows of a thread, and the rows.
fn by_workers<T: Send>(
    index: &wayfold::Index,
    rows: &[f64],
    workers: usize,
    answer: impl Fn(&wayfold::Index, Range<usize>, &[f64]) -> Result<Vec<T>, Error> + Sync,
) -> Result<Vec<T>, Error> {
    let width = index.space().coordinates();
    let count = rows.len() / width;
    if workers.min(count) <= 1 {
        return answer(index, 0..count, rows);
    }
    let rows_each = count.div_ceil(workers);
    let answer = &answer;
    thread::scope(|scope| {
        let threads: Vec<_> = rows
            .chunks(rows_each * width)
            .enumerate()
            .map(|(number, rows)| {
                let first = number * rows_each;
                let part = first..first + rows.len() / width;
                thread::Builder::new().spawn_scoped(scope, move || answer(index, part, rows))
            })
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
pub(crate) fn later_row(error: Error, first: usize) -> Error {
    match error {
        Error::State { row, error } => Error::State {
            row: row + first,
            error,
        },
        error => error,
    }
}

/// One radius for all states, or one for each.
fn radii(r: &Bound<'_, PyAny>, shape: &[usize]) -> PyResult<Vec<f64>> {
    // That numpy turns an array of one element into a number is deprecated.
    let is_array = matches!(r.getattr("ndim").and_then(|it| it.extract()), Ok(1_usize..));
    if !is_array && let Ok(radius) = r.extract() {
        return Ok(vec![radius]);
    }
    static BROADCAST: PyOnceLock<Py<PyAny>> = PyOnceLock::new();
    let broadcast = BROADCAST.import(r.py(), "wayfold._states", "broadcast")?;
    broadcast.call1((r, shape.to_vec()))?.extract()
}

fn array<'py, T: numpy::Element>(
    py: Python<'py>,
    shape: &[usize],
    cells: Vec<T>,
) -> PyResult<Bound<'py, PyArrayDyn<T>>> {
    let array = ArrayD::from_shape_vec(shape.to_vec(), cells);
    let array = array.map_err(|error| invalid(py, &format!("the answer has no shape: {error}")))?;
    Ok(PyArrayDyn::from_owned_array(py, array))
}
