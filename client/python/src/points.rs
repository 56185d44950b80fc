//! The answers of calls.

use std::sync::{Mutex, PoisonError};

use numpy::{Element, PyArray1, PyArray2, PyArrayMethods};
use pyo3::{prelude::*, types::PyBytes};

use crate::error::OrRaise;

/// A stored point and its distance.
#[pyclass(frozen, get_all, module = "wayfold")]
#[derive(Debug)]
pub(crate) struct Neighbor {
    id: u64,
    distance: f64,
}

#[pymethods]
impl Neighbor {
    fn __repr__(&self) -> String {
        format!("Neighbor(id={}, distance={:?})", self.id, self.distance)
    }
}

impl From<wayfold::Neighbor> for Neighbor {
    fn from(neighbor: wayfold::Neighbor) -> Neighbor {
        Neighbor {
            id: neighbor.id,
            distance: neighbor.distance,
        }
    }
}

/// The neighbours of a state, nearest first and at equal distances by id.
#[pyclass(frozen, get_all, module = "wayfold")]
#[derive(Debug)]
pub(crate) struct SearchResult {
    ids: Py<PyArray1<i64>>,
    distances: Py<PyArray1<f64>>,
    read_revision: u64,
    #[pyo3(name = "_count")]
    count: usize,
}

impl SearchResult {
    pub(crate) fn of(py: Python<'_>, found: &wayfold::SearchResult) -> SearchResult {
        let (ids, distances) = columns(py, &found.neighbors);
        SearchResult {
            ids: ids.unbind(),
            distances: distances.unbind(),
            read_revision: found.read_revision.0,
            count: found.neighbors.len(),
        }
    }
}

#[pymethods]
impl SearchResult {
    fn __len__(&self) -> usize {
        self.count
    }

    fn __repr__(&self, py: Python<'_>) -> PyResult<String> {
        let (ids, distances) = (self.ids.bind(py).repr()?, self.distances.bind(py).repr()?);
        Ok(format!(
            "SearchResult(ids={ids}, distances={distances}, read_revision={})",
            self.read_revision
        ))
    }
}

/// The ids and the distances of neighbours.
pub(crate) fn columns<'py>(
    py: Python<'py>,
    neighbors: &[wayfold::Neighbor],
) -> (Bound<'py, PyArray1<i64>>, Bound<'py, PyArray1<f64>>) {
    let ids = neighbors.iter().map(|neighbor| neighbor.id as i64);
    let distances = neighbors.iter().map(|neighbor| neighbor.distance);
    (column(py, ids.collect()), column(py, distances.collect()))
}

/// An array of numbers. It copies a few: a Python object that owns them would cost more.
pub(crate) fn column<T: Element + Copy>(py: Python<'_>, numbers: Vec<T>) -> Bound<'_, PyArray1<T>> {
    const MAX_COPIED: usize = 1_024;
    match numbers.len() <= MAX_COPIED {
        true => PyArray1::from_slice(py, &numbers),
        false => PyArray1::from_vec(py, numbers),
    }
}

/// The id of an inserted point, and the neighbours that its insert found.
#[pyclass(frozen, get_all, module = "wayfold")]
#[derive(Debug)]
pub(crate) struct InsertedPoint {
    id: u64,
    neighbors: Py<SearchResult>,
}

impl InsertedPoint {
    pub(crate) fn of(py: Python<'_>, inserted: &wayfold::InsertedPoint) -> PyResult<InsertedPoint> {
        let neighbors = SearchResult::of(py, &inserted.neighbors);
        Ok(InsertedPoint {
            id: inserted.id,
            neighbors: Py::new(py, neighbors)?,
        })
    }
}

/// One stored point.
#[pyclass(frozen, get_all, module = "wayfold")]
#[derive(Debug)]
pub(crate) struct StoredPoint {
    id: u64,
    tag: u64,
    state: Py<PyArray1<f64>>,
}

#[pymethods]
impl StoredPoint {
    fn __repr__(&self, py: Python<'_>) -> PyResult<String> {
        let state = self.state.bind(py).repr()?;
        Ok(format!(
            "StoredPoint(id={}, tag={}, state={state})",
            self.id, self.tag
        ))
    }
}

impl StoredPoint {
    pub(crate) fn of(py: Python<'_>, point: wayfold::StoredPoint) -> StoredPoint {
        StoredPoint {
            id: point.id,
            tag: point.tag,
            state: column(py, point.state).unbind(),
        }
    }
}

/// All points of an index as they were when the scan began: an iterator over `StoredPoint`.
#[pyclass(frozen, module = "wayfold")]
#[derive(Debug)]
pub(crate) struct StoredPoints {
    points: Mutex<wayfold::StoredPoints>,
    width: usize,
}

/// Ids, tags and states of points.
pub(crate) type Columns<'py> = (
    Bound<'py, PyArray1<i64>>,
    Bound<'py, PyArray1<u64>>,
    Bound<'py, PyArray2<f64>>,
);

impl StoredPoints {
    pub(crate) fn of(points: wayfold::StoredPoints, width: usize) -> StoredPoints {
        StoredPoints {
            points: Mutex::new(points),
            width,
        }
    }

    /// The ids, the tags and the numbers of the states of the points that the iterator has not returned.
    pub(crate) fn read(&self, py: Python<'_>) -> PyResult<(Vec<u64>, Vec<u64>, Vec<f64>)> {
        let read = py.detach(|| {
            let mut points = self.points.lock().unwrap_or_else(PoisonError::into_inner);
            let (mut ids, mut tags, mut states) = (Vec::new(), Vec::new(), Vec::new());
            for point in &mut *points {
                let point = point?;
                ids.push(point.id);
                tags.push(point.tag);
                states.extend(point.state);
            }
            Ok((ids, tags, states))
        });
        read.or_raise(py)
    }
}

#[pymethods]
impl StoredPoints {
    fn __iter__(slf: PyRef<'_, Self>) -> PyRef<'_, Self> {
        slf
    }

    fn __next__(&self, py: Python<'_>) -> PyResult<Option<StoredPoint>> {
        let next = py.detach(|| {
            let mut points = self.points.lock().unwrap_or_else(PoisonError::into_inner);
            points.next().transpose()
        });
        let next = next.or_raise(py)?;
        Ok(next.map(|point| StoredPoint::of(py, point)))
    }

    /// The ids, the tags and the states of the points that the iterator has not returned.
    fn columns<'py>(&self, py: Python<'py>) -> PyResult<Columns<'py>> {
        let (ids, tags, states) = self.read(py)?;
        let shape = [ids.len(), self.width];
        let ids = ids.iter().map(|&id| id as i64);
        Ok((
            PyArray1::from_iter(py, ids),
            PyArray1::from_vec(py, tags),
            PyArray1::from_vec(py, states).reshape(shape)?,
        ))
    }
}

/// Everything that changed after an earlier answer.
#[pyclass(frozen, get_all, module = "wayfold")]
#[derive(Debug)]
pub(crate) struct Changes {
    stored: Vec<Py<StoredPoint>>,
    removed: Vec<u64>,
    read_revision: u64,
}

impl Changes {
    pub(crate) fn of(py: Python<'_>, changes: wayfold::Changes) -> PyResult<Changes> {
        let stored = changes.stored.into_iter();
        let stored = stored.map(|point| Py::new(py, StoredPoint::of(py, point)));
        Ok(Changes {
            stored: stored.collect::<PyResult<_>>()?,
            removed: changes.removed,
            read_revision: changes.read_revision.0,
        })
    }
}

/// An own point's place in the index's order, and the neighbours that its insert could not see, or left out because its scaled
/// `k` was smaller then.
#[pyclass(frozen, get_all, module = "wayfold")]
#[derive(Debug)]
pub(crate) struct Meanwhile {
    id: u64,
    points_before: usize,
    ids: Py<PyArray1<i64>>,
    distances: Py<PyArray1<f64>>,
    is_superset: bool,
}

/// The answers to the searches of inserts, as far as the server has stored the points.
#[pyclass(frozen, get_all, module = "wayfold")]
#[derive(Debug)]
pub(crate) struct MeanwhileAnswers {
    answers: Vec<Py<Meanwhile>>,
    open: usize,
    has_dropped: bool,
}

impl MeanwhileAnswers {
    pub(crate) fn of(
        py: Python<'_>,
        answers: wayfold::MeanwhileAnswers,
    ) -> PyResult<MeanwhileAnswers> {
        let one = |answer: &wayfold::Meanwhile| {
            let (ids, distances) = columns(py, &answer.neighbors);
            let answer = Meanwhile {
                id: answer.id,
                points_before: answer.points_before,
                ids: ids.unbind(),
                distances: distances.unbind(),
                is_superset: answer.is_superset,
            };
            Py::new(py, answer)
        };
        Ok(MeanwhileAnswers {
            answers: answers.answers.iter().map(one).collect::<PyResult<_>>()?,
            open: answers.open,
            has_dropped: answers.has_dropped,
        })
    }
}

/// The state of a shared index's connection.
#[pyclass(frozen, get_all, module = "wayfold")]
#[derive(Debug)]
pub(crate) struct ConnectionStatus {
    /// `following`, `reloading`, `disconnected`, `refused`, `ended` or `closed`.
    name: &'static str,
    /// The number of revisions by which the server was ahead; only of `following`.
    behind: Option<u64>,
    /// The error of `disconnected`, `refused` and `ended`.
    why: Option<String>,
}

#[pymethods]
impl ConnectionStatus {
    fn __repr__(&self) -> String {
        format!("{self:?}")
    }
}

impl From<wayfold::ConnectionStatus> for ConnectionStatus {
    fn from(status: wayfold::ConnectionStatus) -> ConnectionStatus {
        use wayfold::ConnectionStatus as Of;
        let (name, behind, why) = match status {
            Of::Following { behind } => ("following", Some(behind), None),
            Of::Reloading => ("reloading", None, None),
            Of::Disconnected { why, .. } => ("disconnected", None, Some(why)),
            Of::Refused { why } => ("refused", None, Some(why)),
            Of::Ended { why } => ("ended", None, Some(why)),
            Of::Closed => ("closed", None, None),
            _ => ("unknown", None, None),
        };
        ConnectionStatus {
            name,
            behind,
            why: why.map(|why| why.to_string()),
        }
    }
}

/// A write that was not sent, or that the server refused.
#[pyclass(frozen, get_all, module = "wayfold")]
#[derive(Debug)]
pub(crate) struct UnsentWrite {
    /// `put`, `replace`, `remove`, `set_tag` or `set_payload`.
    kind: &'static str,
    id: u64,
    tag: Option<u64>,
    state: Option<Py<PyArray1<f64>>>,
    payload: Option<Py<PyBytes>>,
}

impl UnsentWrite {
    pub(crate) fn of(py: Python<'_>, write: wayfold::UnsentWrite) -> UnsentWrite {
        use wayfold::UnsentWrite as Of;
        let (kind, id, tag, state, payload) = match write {
            Of::Put {
                id,
                tag,
                state,
                payload,
            } => ("put", id, Some(tag), Some(state), Some(payload)),
            Of::Replace { id, state } => ("replace", id, None, Some(state), None),
            Of::Remove { id } => ("remove", id, None, None, None),
            Of::SetTag { id, tag } => ("set_tag", id, Some(tag), None, None),
            Of::SetPayload { id, payload } => ("set_payload", id, None, None, Some(payload)),
        };
        UnsentWrite {
            kind,
            id,
            tag,
            state: state.map(|state| PyArray1::from_vec(py, state).unbind()),
            payload: payload.map(|payload| PyBytes::new(py, &payload).unbind()),
        }
    }
}
