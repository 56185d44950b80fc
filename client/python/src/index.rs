//! The class `Index`.

use std::{
    fmt,
    hint::black_box,
    sync::atomic::{AtomicU64, Ordering},
    time::Instant,
};

use numpy::{
    PyArray1, PyArrayDyn, PyArrayMethods, PyReadonlyArray1, PyReadonlyArray2, ndarray::ArrayD,
};
use pyo3::{
    IntoPyObjectExt,
    exceptions::PyTypeError,
    prelude::*,
    sync::PyOnceLock,
    types::{PyBytes, PyList, PyTuple, PyType},
};
use wayfold::{Factor, InsertOptions, Neighbor as FoundNeighbor};

use crate::{
    error::{OrRaise, invalid},
    points::{
        Changes, Found, InsertedPoint, MeanwhileAnswers, Neighbor, Status, StoredPoint,
        StoredPoints, UnsentWrite, columns,
    },
    query::{self, Ranks},
    rows::{Rows, one_state, rows},
    search::{Radius, Search, k_of, seconds},
    space::{Space, names, of_argument},
};

/// The place of the points.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Form {
    /// This process. With `is_inline`, an insert that fills a level merges it itself.
    Memory { is_inline: bool },
    /// This process and a server.
    Shared,
    /// A server.
    Remote,
}

/// A dynamic set of states with exact nearest-neighbour search.
#[pyclass(frozen, module = "wayfold")]
pub(crate) struct Index {
    index: wayfold::Index,
    form: Form,
    /// The names of the coordinates of a state.
    names: Py<PyTuple>,
    /// Above every id that the index in memory has given: `save` keeps it, so that no id is given twice.
    next_id: AtomicU64,
}

impl Index {
    pub(crate) fn of(py: Python<'_>, index: wayfold::Index, form: Form) -> PyResult<Index> {
        Ok(Index {
            names: names(py, index.space())?,
            index,
            form,
            next_id: AtomicU64::new(0),
        })
    }

    fn in_memory(py: Python<'_>, space: &wayfold::Space, is_inline: bool) -> PyResult<Index> {
        let index = match is_inline {
            true => wayfold::Index::in_memory_inline(space),
            false => wayfold::Index::in_memory(space),
        };
        Index::of(py, index.or_raise(py)?, Form::Memory { is_inline })
    }

    fn one(&self, state: &Bound<'_, PyAny>) -> PyResult<Vec<f64>> {
        one_state(state, self.index.space(), self.names.bind(state.py()))
    }

    fn rows(&self, states: &Bound<'_, PyAny>) -> PyResult<Rows> {
        rows(states, self.index.space(), self.names.bind(states.py()))
    }

    fn gave(&self, id: u64) {
        self.next_id.fetch_max(id + 1, Ordering::Relaxed);
    }

    /// Runs a call without the interpreter's lock.
    fn call<T: Send>(
        &self,
        py: Python<'_>,
        call: impl FnOnce(&wayfold::Index) -> Result<T, wayfold::Error> + Send,
    ) -> PyResult<T> {
        py.detach(|| call(&self.index)).or_raise(py)
    }
}

impl fmt::Debug for Index {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.index.fmt(f)
    }
}

#[pymethods]
impl Index {
    #[new]
    #[pyo3(signature = (space, *, inline=false))]
    fn new(space: &Bound<'_, PyAny>, inline: bool) -> PyResult<Index> {
        Index::in_memory(space.py(), &of_argument(space)?, inline)
    }

    /// The space of the states.
    #[getter]
    fn space(&self) -> Space {
        Space::of(self.index.space().clone())
    }

    /// The form of the index: `memory`, `shared` or `remote`.
    #[getter]
    fn form(&self) -> &'static str {
        match self.form {
            Form::Memory { .. } => "memory",
            Form::Shared => "shared",
            Form::Remote => "remote",
        }
    }

    fn __len__(&self, py: Python<'_>) -> PyResult<usize> {
        self.call(py, wayfold::Index::len)
    }

    fn __bool__(&self) -> bool {
        // An empty index is no missing one.
        true
    }

    fn __contains__(&self, py: Python<'_>, id: u64) -> PyResult<bool> {
        Ok(self.call(py, |index| index.get(id))?.is_some())
    }

    /// True if there are no points.
    fn is_empty(&self, py: Python<'_>) -> PyResult<bool> {
        self.call(py, wayfold::Index::is_empty)
    }

    /// Stores a state and returns its id.
    #[pyo3(signature = (state, *, id=None, tag=0, payload=None))]
    fn insert(
        &self,
        state: &Bound<'_, PyAny>,
        id: Option<u64>,
        tag: u64,
        payload: Option<&[u8]>,
    ) -> PyResult<u64> {
        let row = self.one(state)?;
        let options = options(id, tag, payload);
        let inserted = self.call(state.py(), |index| index.insert_with(&row[..], options))?;
        self.gave(inserted.id);
        Ok(inserted.id)
    }

    /// Stores a state, and searches the points before it at once.
    #[pyo3(signature = (state, ask, *, id=None, tag=0, payload=None))]
    fn insert_with(
        &self,
        state: &Bound<'_, PyAny>,
        ask: &Bound<'_, Search>,
        id: Option<u64>,
        tag: u64,
        payload: Option<&[u8]>,
    ) -> PyResult<InsertedPoint> {
        let (py, row) = (state.py(), self.one(state)?);
        let options = options(id, tag, payload).ask(ask.get().search);
        let inserted = self.call(py, |index| index.insert_with(&row[..], options))?;
        self.gave(inserted.id);
        let found = &inserted.found;
        Ok(InsertedPoint {
            id: inserted.id,
            found: Py::new(py, Found::of(py, &found.neighbors, found.seen.0))?,
        })
    }

    /// Stores many states at once and returns their ids, which ascend.
    fn insert_many<'py>(
        &self,
        states: &Bound<'py, PyAny>,
    ) -> PyResult<Bound<'py, PyArrayDyn<i64>>> {
        let (py, Rows { numbers, shape }) = (states.py(), self.rows(states)?);
        let width = self.index.space().coordinates();
        let ids = self.call(py, |index| index.insert_many(numbers.chunks_exact(width)))?;
        if let Some(&last) = ids.last() {
            self.gave(last);
        }
        let ids = ids.iter().map(|&id| id as i64);
        PyArray1::from_iter(py, ids).reshape(shape)
    }

    /// Removes a point. False if there is none with this id.
    fn remove(&self, py: Python<'_>, id: u64) -> PyResult<bool> {
        self.call(py, |index| index.remove(id))
    }

    /// Moves a point to another state; it keeps its tag and loses its payload. False if there is none with this id.
    fn replace(&self, id: u64, state: &Bound<'_, PyAny>) -> PyResult<bool> {
        let row = self.one(state)?;
        self.call(state.py(), |index| index.replace(id, &row[..]))
    }

    /// Sets the tag of a point. False if there is none with this id.
    fn set_tag(&self, py: Python<'_>, id: u64, tag: u64) -> PyResult<bool> {
        self.call(py, |index| index.set_tag(id, tag))
    }

    /// Sets the payload of a point. False if there is none with this id.
    fn set_payload(&self, py: Python<'_>, id: u64, payload: &[u8]) -> PyResult<bool> {
        self.call(py, |index| index.set_payload(id, payload))
    }

    /// The point with this id, or None.
    fn get(&self, py: Python<'_>, id: u64) -> PyResult<Option<StoredPoint>> {
        let point = self.call(py, |index| index.get(id))?;
        Ok(point.map(|point| StoredPoint::of(py, point)))
    }

    /// The payload of the point with this id: empty if it has none, None if there is no such point.
    fn payload<'py>(&self, py: Python<'py>, id: u64) -> PyResult<Option<Bound<'py, PyBytes>>> {
        let payload = self.call(py, |index| index.payload(id))?;
        Ok(payload.map(|payload| PyBytes::new(py, &payload)))
    }

    /// The nearest point; None if there are no points.
    fn nearest(&self, state: &Bound<'_, PyAny>) -> PyResult<Option<Neighbor>> {
        let row = self.one(state)?;
        let nearest = self.call(state.py(), |index| index.nearest(&row[..]))?;
        Ok(nearest.map(Neighbor::from))
    }

    /// The `k` nearest points, nearest first.
    fn nearest_k(&self, state: &Bound<'_, PyAny>, k: i64) -> PyResult<Found> {
        let search = wayfold::Search::k(k_of(state.py(), k)?);
        self.found(state, &search)
    }

    /// All points at distance `radius` or nearer, nearest first.
    fn nearest_r(&self, state: &Bound<'_, PyAny>, radius: Radius<'_>) -> PyResult<Found> {
        self.found(state, &wayfold::Search::within(radius))
    }

    /// Answers any search.
    fn search(&self, state: &Bound<'_, PyAny>, search: &Bound<'_, Search>) -> PyResult<Found> {
        self.found(state, &search.get().search)
    }

    /// Answers a search of many states, which see the same points: their ids and their distances.
    fn search_many<'py>(
        &self,
        states: &Bound<'py, PyAny>,
        search: &Bound<'py, Search>,
    ) -> PyResult<Vec<IdsAndDistances<'py>>> {
        let (py, rows) = (states.py(), self.rows(states)?);
        let (width, search) = (self.index.space().coordinates(), search.get().search);
        let states = rows.numbers.chunks_exact(width);
        let found = self.call(py, |index| index.search_many(states, &search))?;
        Ok(found.iter().map(|found| columns(py, found)).collect())
    }

    /// All points as they are now, by ascending id.
    fn scan(&self, py: Python<'_>) -> PyResult<StoredPoints> {
        let points = self.call(py, wayfold::Index::scan)?;
        Ok(StoredPoints::of(points, self.index.space().coordinates()))
    }

    /// Everything that changed after an answer that has seen this much; None if the index has forgotten some of it.
    fn changes(&self, py: Python<'_>, seen: u64) -> PyResult<Option<Changes>> {
        let changes = self.call(py, |index| index.changes(wayfold::Seen(seen)))?;
        changes.map(|changes| Changes::of(py, changes)).transpose()
    }

    /// Forgets all points of an index in memory; their ids stay used.
    fn clear(&self, py: Python<'_>) -> PyResult<()> {
        self.call(py, wayfold::Index::clear)
    }

    /// Removes all points that the index has now, one by one, for everybody.
    fn remove_all(&self, py: Python<'_>) -> PyResult<()> {
        self.call(py, wayfold::Index::remove_all)
    }

    /// The distances and the ids of the nearest neighbours of states, as scipy's `KDTree.query`.
    #[pyo3(
        signature = (x, k=None, *, eps=0.0, distance_upper_bound=f64::INFINITY, workers=1),
        text_signature = "($self, x, k=1, *, eps=0.0, distance_upper_bound=inf, workers=1)"
    )]
    fn query<'py>(
        &self,
        x: &Bound<'py, PyAny>,
        k: Option<&Bound<'py, PyAny>>,
        eps: f64,
        distance_upper_bound: f64,
        workers: i64,
    ) -> PyResult<Bound<'py, PyTuple>> {
        let (py, bound) = (x.py(), distance_upper_bound);
        let Rows { numbers, mut shape } = self.rows(x)?;
        let ranks = k.map_or(Ok(Ranks::First(1)), Ranks::of)?;
        let search = query::search(py, ranks.k(), eps, bound)?;
        if shape.is_empty() {
            let found = self.call(py, |index| index.search(&numbers[..], &search))?;
            let neighbors = query::within(&found.neighbors, bound);
            return match ranks {
                Ranks::First(1) => {
                    let first = neighbors.first();
                    let distance = first.map_or(f64::INFINITY, |first| first.distance);
                    let id = first.map_or(-1, |first| first.id as i64);
                    (distance, id).into_pyobject(py)
                }
                ranks => {
                    let (distances, ids) = ranks.table([neighbors].into_iter());
                    let distances = PyArray1::from_vec(py, distances);
                    (distances, PyArray1::from_vec(py, ids)).into_pyobject(py)
                }
            };
        }
        let workers = query::workers(py, workers)?;
        let (distances, ids) = self.call(py, |index| {
            let found = query::search_many(index, &numbers, &search, workers)?;
            let found = found.iter().map(|row| query::within(row, bound));
            Ok(ranks.table(found))
        })?;
        if !matches!(ranks, Ranks::First(1)) {
            shape.push(ranks.columns());
        }
        (array(py, &shape, distances)?, array(py, &shape, ids)?).into_pyobject(py)
    }

    /// The ids of all points at distance `r` or nearer, as scipy's `KDTree.query_ball_point`.
    #[pyo3(signature = (x, r, *, eps=0.0, workers=1, return_sorted=None, return_length=false))]
    fn query_ball_point<'py>(
        &self,
        x: &Bound<'py, PyAny>,
        r: &Bound<'py, PyAny>,
        eps: f64,
        workers: i64,
        return_sorted: Option<bool>,
        return_length: bool,
    ) -> PyResult<Bound<'py, PyAny>> {
        let py = x.py();
        let Rows { numbers, shape } = self.rows(x)?;
        query::check_eps(py, eps)?;
        let workers = query::workers(py, workers)?;
        let radii = radii(r, &shape)?;
        for &radius in &radii {
            query::check_number(py, "r", radius)?;
        }
        let width = self.index.space().coordinates();
        let is_sorted = return_sorted.unwrap_or(!shape.is_empty());
        let ids = self.call(py, |index| {
            let within = |radius: f64| wayfold::Search::within(radius).epsilon(eps);
            let found = match radii[..] {
                [radius] => query::search_many(index, &numbers, &within(radius), workers)?,
                _ => numbers
                    .chunks_exact(width)
                    .zip(&radii)
                    .map(|(row, &radius)| Ok(index.search(row, &within(radius))?.neighbors))
                    .collect::<Result<_, wayfold::Error>>()?,
            };
            let ids = found.into_iter().map(|found: Vec<FoundNeighbor>| {
                let mut ids: Vec<u64> = found.iter().map(|found| found.id).collect();
                if is_sorted {
                    ids.sort_unstable();
                }
                ids
            });
            Ok(ids.collect::<Vec<_>>())
        })?;
        if return_length {
            let lengths: Vec<i64> = ids.iter().map(|ids| ids.len() as i64).collect();
            return match lengths[..] {
                [length] if shape.is_empty() => length.into_bound_py_any(py),
                _ => Ok(array(py, &shape, lengths)?.into_any()),
            };
        }
        let mut lists = ids.into_iter();
        if shape.is_empty() {
            return lists.next().unwrap_or_default().into_bound_py_any(py);
        }
        static LISTS: PyOnceLock<Py<PyAny>> = PyOnceLock::new();
        let array_of_lists = LISTS.import(py, "wayfold._states", "array_of_lists")?;
        array_of_lists.call1((PyList::new(py, lists)?, shape))
    }

    /// Waits until the server has acknowledged every write before this call. Returns at once for the other forms.
    fn flush(&self, py: Python<'_>) -> PyResult<()> {
        self.call(py, wayfold::Index::flush)
    }

    /// The number of writes that the server has not acknowledged; 0 for the other forms.
    fn pending(&self, py: Python<'_>) -> u64 {
        py.detach(|| self.index.pending())
    }

    /// The state of a shared index's connection; None for the other forms.
    fn status(&self, py: Python<'_>) -> Option<Status> {
        py.detach(|| self.index.status()).map(Status::from)
    }

    /// The answers about own points that were inserted with a question.
    fn meanwhile(&self, py: Python<'_>) -> PyResult<MeanwhileAnswers> {
        MeanwhileAnswers::of(py, py.detach(|| self.index.meanwhile()))
    }

    /// Acts like `meanwhile`, but waits for an answer, at most `timeout` seconds, if there is none and one is to come.
    fn wait_meanwhile(&self, py: Python<'_>, timeout: f64) -> PyResult<MeanwhileAnswers> {
        let timeout = seconds(py, "timeout", timeout)?;
        MeanwhileAnswers::of(py, py.detach(|| self.index.wait_meanwhile(timeout)))
    }

    /// Every write from the first one on that the server refused for good, in order.
    fn take_unsent(&self, py: Python<'_>) -> Vec<UnsentWrite> {
        let unsent = py.detach(|| self.index.take_unsent());
        let unsent = unsent.into_iter();
        unsent.map(|write| UnsentWrite::of(py, write)).collect()
    }

    /// Takes no more writes, waits for the pending ones, and returns those that the server has not acknowledged within
    /// `timeout` seconds.
    #[pyo3(signature = (timeout=30.0))]
    fn close(&self, py: Python<'_>, timeout: f64) -> PyResult<Vec<UnsentWrite>> {
        let timeout = seconds(py, "timeout", timeout)?;
        let unsent = py.detach(|| self.index.close(timeout)).into_iter();
        Ok(unsent.map(|write| UnsentWrite::of(py, write)).collect())
    }

    fn __enter__(slf: PyRef<'_, Self>) -> PyRef<'_, Self> {
        slf
    }

    #[pyo3(signature = (kind, error, traceback))]
    fn __exit__(
        &self,
        kind: Option<&Bound<'_, PyAny>>,
        error: Option<&Bound<'_, PyAny>>,
        traceback: &Bound<'_, PyAny>,
    ) -> PyResult<()> {
        let (py, _) = (traceback.py(), error);
        if kind.is_none() {
            // Raises the reason, if the writes cannot be sent. `close` has only the writes.
            self.flush(py)?;
        }
        self.close(py, 30.0)?;
        Ok(())
    }

    /// Writes all points of an index in memory to a file, which `load` reads.
    fn save(slf: &Bound<'_, Self>, path: &Bound<'_, PyAny>) -> PyResult<()> {
        static SAVE: PyOnceLock<Py<PyAny>> = PyOnceLock::new();
        let save = SAVE.import(slf.py(), "wayfold._file", "save")?;
        save.call1((path, slf.get().content(slf.py())?))?;
        Ok(())
    }

    /// The index in memory that `save` wrote to a file.
    #[classmethod]
    fn load<'py>(
        class: &Bound<'py, PyType>,
        path: &Bound<'py, PyAny>,
    ) -> PyResult<Bound<'py, PyAny>> {
        static LOAD: PyOnceLock<Py<PyAny>> = PyOnceLock::new();
        LOAD.import(class.py(), "wayfold._file", "load")?
            .call1((path,))
    }

    fn __reduce__<'py>(slf: &Bound<'py, Self>) -> PyResult<(Bound<'py, PyAny>, Content<'py>)> {
        static RESTORE: PyOnceLock<Py<PyAny>> = PyOnceLock::new();
        let restore = RESTORE.import(slf.py(), "wayfold._wayfold", "_restore")?;
        Ok((restore.clone(), slf.get().content(slf.py())?))
    }

    fn __repr__(&self) -> String {
        format!("<wayfold.Index {} of {}>", self.form(), self.index.space())
    }
}

/// The neighbours of one state.
type IdsAndDistances<'py> = (Bound<'py, PyArray1<i64>>, Bound<'py, PyArray1<f64>>);

/// Everything that an index in memory holds: its space, inline, the next id, the ids, tags and states, the ids of the
/// points with payloads, the ends of the payloads, and the payloads one after the other.
type Content<'py> = (
    String,
    bool,
    u64,
    Bound<'py, PyAny>,
    Bound<'py, PyAny>,
    Bound<'py, PyAny>,
    Bound<'py, PyArray1<u64>>,
    Bound<'py, PyArray1<u64>>,
    Bound<'py, PyBytes>,
);

impl Index {
    fn content<'py>(&self, py: Python<'py>) -> PyResult<Content<'py>> {
        let Form::Memory { is_inline } = self.form else {
            return Err(PyTypeError::new_err(format!(
                "a {} index is neither pickled nor saved: open it in the other process by its name",
                self.form()
            )));
        };
        // Read before the points: of what is stored meanwhile, the ids count below.
        let next_id = self.next_id.load(Ordering::Relaxed);
        let (ids, tags, states) = self.scan(py)?.columns(py)?;
        let stored = ids.to_vec()?;
        let next_id = next_id.max(stored.last().map_or(0, |last| last + 1));
        let (holders, ends, bytes) = self.call(py, |index| {
            let (mut holders, mut ends, mut bytes) = (Vec::new(), Vec::new(), Vec::new());
            for id in stored {
                let payload = index.payload(id)?.unwrap_or_default();
                if !payload.is_empty() {
                    bytes.extend(payload);
                    holders.push(id);
                    ends.push(bytes.len() as u64);
                }
            }
            Ok((holders, ends, bytes))
        })?;
        Ok((
            self.index.space().to_string(),
            is_inline,
            next_id,
            ids.into_any(),
            tags.into_any(),
            states.into_any(),
            PyArray1::from_vec(py, holders),
            PyArray1::from_vec(py, ends),
            PyBytes::new(py, &bytes),
        ))
    }
}

/// The index in memory with this content.
#[pyfunction(name = "_restore")]
#[expect(clippy::too_many_arguments, reason = "the parts of a content")]
pub(crate) fn restore(
    py: Python<'_>,
    space: &Bound<'_, PyAny>,
    is_inline: bool,
    next_id: u64,
    ids: PyReadonlyArray1<'_, u64>,
    tags: PyReadonlyArray1<'_, u64>,
    states: PyReadonlyArray2<'_, f64>,
    holders: PyReadonlyArray1<'_, u64>,
    ends: PyReadonlyArray1<'_, u64>,
    bytes: &[u8],
) -> PyResult<Index> {
    let damaged = |what: &str| invalid(py, &format!("not the content of an index: {what}"));
    let space = of_argument(space)?;
    let width = space.coordinates();
    let (ids, tags) = (ids.to_vec()?, tags.to_vec()?);
    let (holders, ends) = (holders.to_vec()?, ends.to_vec()?);
    let states: Vec<f64> = states.as_array().iter().copied().collect();
    if tags.len() != ids.len() || states.len() != ids.len() * width {
        return Err(damaged("its columns have different lengths"));
    }
    let mut payloads = Vec::with_capacity(holders.len());
    let mut start = 0;
    for (&id, &end) in holders.iter().zip(&ends) {
        let end = usize::try_from(end).unwrap_or(usize::MAX);
        let payload = bytes.get(start..end);
        payloads.push((id, payload.ok_or_else(|| damaged("a payload is cut"))?));
        start = end;
    }
    let index = Index::in_memory(py, &space, is_inline)?;
    index.call(py, |index| {
        for ((&id, &tag), row) in ids.iter().zip(&tags).zip(states.chunks_exact(width)) {
            index.insert_with(row, InsertOptions::new().id(id).tag(tag))?;
        }
        for (id, payload) in payloads {
            index.set_payload(id, payload)?;
        }
        // A point that comes and goes uses the ids up to its own.
        if let Some(last) = next_id
            .checked_sub(1)
            .filter(|&last| ids.last() < Some(&last))
        {
            index.insert_with(any_state(&space), InsertOptions::new().id(last))?;
            index.remove(last)?;
        }
        Ok(())
    })?;
    index.next_id.store(next_id, Ordering::Relaxed);
    Ok(index)
}

/// The seconds that Rust takes for the `k` nearest of all states: in one call, or one after the other. The benchmark
/// compares `query` with it.
#[pyfunction(name = "_seconds_in_rust")]
pub(crate) fn seconds_in_rust(
    index: &Bound<'_, Index>,
    states: &Bound<'_, PyAny>,
    k: u32,
    is_one_call: bool,
) -> PyResult<f64> {
    let (py, index) = (states.py(), index.get());
    let numbers = index.rows(states)?.numbers;
    let (width, search) = (index.index.space().coordinates(), wayfold::Search::k(k));
    index.call(py, |index| {
        let began = Instant::now();
        if is_one_call {
            black_box(index.search_many(numbers.chunks_exact(width), &search)?);
        } else {
            for row in numbers.chunks_exact(width) {
                black_box(index.search(row, &search)?);
            }
        }
        Ok(began.elapsed().as_secs_f64())
    })
}

fn options(id: Option<u64>, tag: u64, payload: Option<&[u8]>) -> InsertOptions<'_> {
    let options = InsertOptions::new().tag(tag);
    let options = id.map_or(options, |id| options.id(id));
    options.payload(payload.unwrap_or_default())
}

/// Some state of the space.
fn any_state(space: &wayfold::Space) -> Vec<f64> {
    let mut row = Vec::with_capacity(space.coordinates());
    for term in space.groups().iter().flat_map(|group| &group.terms) {
        match term.factor {
            Factor::RealVector(n) => row.extend(std::iter::repeat_n(0.0, n)),
            Factor::SO2 { .. } => row.push(0.0),
            Factor::SO3 => row.extend([0.0, 0.0, 0.0, 1.0]),
        }
    }
    row
}

/// One radius for all states, or one for each.
fn radii(r: &Bound<'_, PyAny>, shape: &[usize]) -> PyResult<Vec<f64>> {
    if let Ok(radius) = r.extract() {
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

impl Index {
    fn found(&self, state: &Bound<'_, PyAny>, search: &wayfold::Search) -> PyResult<Found> {
        let (py, row) = (state.py(), self.one(state)?);
        let found = self.call(py, |index| index.search(&row[..], search))?;
        Ok(Found::of(py, &found.neighbors, found.seen.0))
    }
}
