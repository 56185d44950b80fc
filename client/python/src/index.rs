//! The class `Index`.

mod calls;

use std::{fmt, sync::atomic::AtomicU64};

use numpy::{PyArray1, PyArrayDyn, PyArrayMethods};
use pyo3::{
    prelude::*,
    sync::PyOnceLock,
    types::{PyBytes, PyTuple, PyType},
};

pub(crate) use self::calls::Form;
use self::calls::{GivenId, options};
use crate::{
    content::Content,
    points::{
        Changes, ConnectionStatus, InsertedPoint, MeanwhileAnswers, Neighbor, SearchResult,
        StoredPoint, StoredPoints, UnsentWrite,
    },
    query::{self, workers_of},
    rows::Rows,
    search::{Radius, Search, id_of, k_of, seconds, since_of, tag_of},
    space::{Space, of_argument},
};

/// A dynamic set of states with exact nearest-neighbour search.
#[pyclass(frozen, module = "wayfold")]
pub(crate) struct Index {
    pub(crate) index: wayfold::Index,
    pub(crate) form: Form,
    /// The names of the coordinates of a state.
    names: Py<PyTuple>,
    /// Above every id that the index in memory has given: `save` keeps it, so that no id is given twice.
    pub(crate) next_id: AtomicU64,
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
    pub(crate) fn form(&self) -> &'static str {
        match self.form {
            Form::Memory { .. } => "memory",
            Form::Shared => "shared",
            Form::Remote => "remote",
        }
    }

    /// How the payloads hold edges, as the index declared when it was created; None if it declares nothing.
    #[getter]
    fn payload_encoding(&self, py: Python<'_>) -> PyResult<Option<&'static str>> {
        self.declared_encoding(py)
    }

    fn __len__(&self, py: Python<'_>) -> PyResult<usize> {
        self.call(py, wayfold::Index::len)
    }

    fn __bool__(&self) -> bool {
        // An empty index is no missing one.
        true
    }

    fn __contains__(&self, py: Python<'_>, id: GivenId) -> PyResult<bool> {
        self.of_point(py, &id, |index, id| Ok(index.get(id)?.is_some()))
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
        #[pyo3(from_py_with = id_of)] id: Option<u64>,
        #[pyo3(from_py_with = tag_of)] tag: u64,
        payload: Option<&[u8]>,
    ) -> PyResult<u64> {
        Ok(self.inserted(state, options(id, tag, payload))?.id)
    }

    /// Stores a state, and searches the points before it at once.
    #[pyo3(signature = (state, search, *, id=None, tag=0, payload=None))]
    fn insert_with(
        &self,
        state: &Bound<'_, PyAny>,
        search: &Bound<'_, Search>,
        #[pyo3(from_py_with = id_of)] id: Option<u64>,
        #[pyo3(from_py_with = tag_of)] tag: u64,
        payload: Option<&[u8]>,
    ) -> PyResult<InsertedPoint> {
        let options = options(id, tag, payload).neighbors(search.get().search);
        InsertedPoint::of(state.py(), &self.inserted(state, options)?)
    }

    /// Stores many states at once and returns their ids, which ascend.
    fn insert_many<'py>(
        &self,
        states: &Bound<'py, PyAny>,
    ) -> PyResult<Bound<'py, PyArrayDyn<i64>>> {
        let (py, Rows { numbers, shape }) = (states.py(), self.many_rows(states)?);
        let width = self.index.space().coordinates();
        let ids = self.call(py, |index| index.insert_many(numbers.chunks_exact(width)))?;
        if let Some(&last) = ids.last() {
            self.gave(last);
        }
        let ids = ids.iter().map(|&id| id as i64);
        PyArray1::from_iter(py, ids).reshape(shape)
    }

    /// Removes a point. False if there is none with this id.
    fn remove(&self, py: Python<'_>, id: GivenId) -> PyResult<bool> {
        self.of_point(py, &id, wayfold::Index::remove)
    }

    /// Moves a point to another state; it keeps its tag and loses its payload. False if there is none with this id.
    fn replace(&self, id: GivenId, state: &Bound<'_, PyAny>) -> PyResult<bool> {
        let row = self.one(state)?;
        self.of_point(state.py(), &id, |index, id| index.replace(id, &row[..]))
    }

    /// Sets the tag of a point. False if there is none with this id.
    fn set_tag(
        &self,
        py: Python<'_>,
        id: GivenId,
        #[pyo3(from_py_with = tag_of)] tag: u64,
    ) -> PyResult<bool> {
        self.of_point(py, &id, |index, id| index.set_tag(id, tag))
    }

    /// Sets the payload of a point. False if there is none with this id.
    fn set_payload(&self, py: Python<'_>, id: GivenId, payload: &[u8]) -> PyResult<bool> {
        self.of_point(py, &id, |index, id| index.set_payload(id, payload))
    }

    /// The point with this id, or None.
    fn get(&self, py: Python<'_>, id: GivenId) -> PyResult<Option<StoredPoint>> {
        let point = self.of_point(py, &id, wayfold::Index::get)?;
        Ok(point.map(|point| StoredPoint::of(py, point)))
    }

    /// The payload of the point with this id: empty if it has none, None if there is no such point.
    fn payload<'py>(&self, py: Python<'py>, id: GivenId) -> PyResult<Option<Bound<'py, PyBytes>>> {
        let payload = self.of_point(py, &id, wayfold::Index::payload)?;
        Ok(payload.map(|payload| PyBytes::new(py, &payload)))
    }

    /// The payloads of the points with these ids, in their order: None if there is no such point.
    fn payloads(&self, py: Python<'_>, ids: Vec<GivenId>) -> PyResult<Vec<Option<Vec<u8>>>> {
        let points: Vec<u64> = ids.iter().filter_map(|id| id.0).collect();
        let mut payloads = self.call(py, |index| index.payloads(&points))?.into_iter();
        let of = |id: &GivenId| id.0.and_then(|_| payloads.next().flatten());
        Ok(ids.iter().map(of).collect())
    }

    /// The nearest point; None if there are no points.
    fn nearest(&self, state: &Bound<'_, PyAny>) -> PyResult<Option<Neighbor>> {
        let row = self.one(state)?;
        let nearest = self.call(state.py(), |index| index.nearest(&row[..]))?;
        Ok(nearest.map(Neighbor::from))
    }

    /// The `k` nearest points, nearest first.
    fn nearest_k(
        &self,
        state: &Bound<'_, PyAny>,
        #[pyo3(from_py_with = k_of)] k: u32,
    ) -> PyResult<SearchResult> {
        self.found(state, &wayfold::Search::k(k))
    }

    /// All points at distance `radius` or nearer, nearest first.
    fn nearest_r(&self, state: &Bound<'_, PyAny>, radius: Radius<'_>) -> PyResult<SearchResult> {
        self.found(state, &wayfold::Search::within(radius))
    }

    /// Answers any search.
    fn search(
        &self,
        state: &Bound<'_, PyAny>,
        search: &Bound<'_, Search>,
    ) -> PyResult<SearchResult> {
        self.found(state, &search.get().search)
    }

    /// Answers a search of many states, which see the same points.
    fn search_many(
        &self,
        states: &Bound<'_, PyAny>,
        search: &Bound<'_, Search>,
    ) -> PyResult<Vec<SearchResult>> {
        let search = search.get().search;
        self.found_many(states, |index, rows| index.search_many(rows, &search))
    }

    /// Answers a search for each of many states, which see the same points. A remote index takes only one search.
    fn search_each(
        &self,
        states: &Bound<'_, PyAny>,
        searches: Vec<Bound<'_, Search>>,
    ) -> PyResult<Vec<SearchResult>> {
        let searches: Vec<_> = searches.iter().map(|search| search.get().search).collect();
        self.found_many(states, |index, rows| index.search_each(rows, &searches))
    }

    /// All points as they are now, by ascending id.
    pub(crate) fn scan(&self, py: Python<'_>) -> PyResult<StoredPoints> {
        let points = self.call(py, wayfold::Index::scan)?;
        Ok(StoredPoints::of(points, self.index.space().coordinates()))
    }

    /// Everything that changed after the revision that an earlier answer read; None if the index has forgotten some of it.
    fn changes(
        &self,
        py: Python<'_>,
        #[pyo3(from_py_with = since_of)] since: u64,
    ) -> PyResult<Option<Changes>> {
        let changes = self.call(py, |index| index.changes(wayfold::ReadRevision(since)))?;
        changes.map(|changes| Changes::of(py, changes)).transpose()
    }

    /// Forgets all points of an index in memory; their ids stay used.
    fn clear(&self, py: Python<'_>) -> PyResult<()> {
        self.call(py, wayfold::Index::clear)
    }

    /// Removes all points that the index has now, for everybody: it reads all their ids first.
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
        #[pyo3(from_py_with = workers_of)] workers: usize,
    ) -> PyResult<Bound<'py, PyTuple>> {
        query::nearest(
            self,
            x,
            k,
            &query::Nearest {
                eps,
                bound: distance_upper_bound,
                workers,
            },
        )
    }

    /// The ids of all points at distance `r` or nearer, as scipy's `KDTree.query_ball_point`.
    #[pyo3(signature = (x, r, *, eps=0.0, workers=1, return_sorted=None, return_length=false))]
    fn query_ball_point<'py>(
        &self,
        x: &Bound<'py, PyAny>,
        r: &Bound<'py, PyAny>,
        eps: f64,
        #[pyo3(from_py_with = workers_of)] workers: usize,
        return_sorted: Option<bool>,
        return_length: bool,
    ) -> PyResult<Bound<'py, PyAny>> {
        let ball = query::Ball {
            eps,
            workers,
            is_sorted: return_sorted,
            is_length: return_length,
        };
        query::ball(self, x, r, &ball)
    }

    /// Waits until the server has acknowledged every write before this call. Returns at once for the other forms.
    fn flush(&self, py: Python<'_>) -> PyResult<()> {
        self.call(py, wayfold::Index::flush)
    }

    /// Acts like `flush`, but waits at most `timeout` seconds instead of the index's own timeout.
    fn flush_within(&self, py: Python<'_>, timeout: f64) -> PyResult<()> {
        let timeout = seconds(py, timeout)?;
        self.call(py, |index| index.flush_within(timeout))
    }

    /// The number of writes that the server has not acknowledged; 0 for the other forms.
    fn pending(&self, py: Python<'_>) -> PyResult<u64> {
        self.check_process(py)?;
        Ok(py.detach(|| self.index.pending()))
    }

    /// The state of a shared index's connection; None for the other forms.
    fn status(&self, py: Python<'_>) -> PyResult<Option<ConnectionStatus>> {
        self.check_process(py)?;
        Ok(py
            .detach(|| self.index.status())
            .map(ConnectionStatus::from))
    }

    /// The answers about own points that were inserted with a search.
    fn meanwhile(&self, py: Python<'_>) -> PyResult<MeanwhileAnswers> {
        self.check_process(py)?;
        MeanwhileAnswers::of(py, py.detach(|| self.index.meanwhile()))
    }

    /// Acts like `meanwhile`, but waits for an answer, at most `timeout` seconds, if there is none and one is to come.
    fn wait_meanwhile(&self, py: Python<'_>, timeout: f64) -> PyResult<MeanwhileAnswers> {
        let timeout = seconds(py, timeout)?;
        let answers = self.wait(py, |index| index.wait_meanwhile(timeout))?;
        MeanwhileAnswers::of(py, answers)
    }

    /// Every write from the first one on that the server refused for good, in order.
    fn take_unsent(&self, py: Python<'_>) -> PyResult<Vec<UnsentWrite>> {
        self.check_process(py)?;
        let unsent = py.detach(|| self.index.take_unsent()).into_iter();
        Ok(unsent.map(|write| UnsentWrite::of(py, write)).collect())
    }

    /// Takes no more writes, waits for the pending ones, and returns those that the server has not acknowledged within
    /// `timeout` seconds.
    #[pyo3(signature = (timeout=30.0))]
    fn close(&self, py: Python<'_>, timeout: f64) -> PyResult<Vec<UnsentWrite>> {
        let timeout = seconds(py, timeout)?;
        let unsent = self.wait(py, |index| index.close(timeout))?.into_iter();
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
        self.exit(py, kind.is_some())
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
