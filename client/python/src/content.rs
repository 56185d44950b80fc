//! Everything that an index in memory holds, as `pickle` and `save` keep it.

use std::sync::atomic::Ordering;

use numpy::{PyArray1, PyArray2, PyArrayMethods, PyReadonlyArray1, PyReadonlyArray2};
use pyo3::{exceptions::PyTypeError, prelude::*, types::PyBytes};
use wayfold::{Factor, InsertOptions};

use crate::{
    error::invalid,
    index::{Form, Index},
    query::later_row,
    space::of_argument,
};

/// Everything that an index in memory holds: its space, inline, the next id, the ids, tags and states, the ids of the
/// points with payloads, the ends of the payloads, and the payloads one after the other.
pub(crate) type Content<'py> = (
    String,
    bool,
    u64,
    Bound<'py, PyArray1<u64>>,
    Bound<'py, PyArray1<u64>>,
    Bound<'py, PyArray2<f64>>,
    Bound<'py, PyArray1<u64>>,
    Bound<'py, PyArray1<u64>>,
    Bound<'py, PyBytes>,
);

impl Index {
    pub(crate) fn content<'py>(&self, py: Python<'py>) -> PyResult<Content<'py>> {
        let Form::Memory { is_inline } = self.form else {
            return Err(PyTypeError::new_err(format!(
                "a {} index is neither pickled nor saved: open it in the other process by its name",
                self.form()
            )));
        };
        // Read before the points: the lines below count the ids of points that are stored meanwhile.
        let next_id = self.next_id.load(Ordering::Relaxed);
        let (ids, tags, states) = self.scan(py)?.read(py)?;
        let next_id = next_id.max(ids.last().map_or(0, |last| last + 1));
        let (holders, ends, bytes) = self.call(py, |index| {
            let (mut holders, mut ends, mut bytes) = (Vec::new(), Vec::new(), Vec::new());
            for &id in &ids {
                let payload = index.payload(id)?.unwrap_or_default();
                if !payload.is_empty() {
                    bytes.extend(payload);
                    holders.push(id);
                    ends.push(bytes.len() as u64);
                }
            }
            Ok((holders, ends, bytes))
        })?;
        let shape = [ids.len(), self.index.space().coordinates()];
        Ok((
            self.index.space().to_string(),
            is_inline,
            next_id,
            PyArray1::from_vec(py, ids),
            PyArray1::from_vec(py, tags),
            PyArray1::from_vec(py, states).reshape(shape)?,
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
    let lengths = [(tags.len(), ids.len()), (states.len(), ids.len() * width)];
    let lengths = lengths.into_iter().chain([(holders.len(), ends.len())]);
    if lengths.into_iter().any(|(one, other)| one != other) {
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
    if start != bytes.len() {
        return Err(damaged("bytes follow the last payload"));
    }
    let index = Index::in_memory(py, &space, is_inline)?;
    index.call(py, |index| {
        let rows = states.chunks_exact(width).enumerate();
        for ((&id, &tag), (number, row)) in ids.iter().zip(&tags).zip(rows) {
            let inserted = index.insert_with(row, InsertOptions::new().id(id).tag(tag));
            inserted.map_err(|error| later_row(error, number))?;
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
