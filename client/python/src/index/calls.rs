//! The calls behind the methods of `Index`: states as rows, and calls without the interpreter's lock.

use std::{
    slice::ChunksExact,
    sync::atomic::{AtomicU64, Ordering},
};

use numpy::PyArray1;
use pyo3::prelude::*;
use wayfold::{Error, InsertOptions, Neighbor};

use super::{Form, Index};
use crate::{
    error::OrRaise,
    points::{SearchResult, columns},
    rows::{Rows, one_state, rows},
    space::names,
};

/// The neighbours of one state.
pub(super) type IdsAndDistances<'py> = (Bound<'py, PyArray1<i64>>, Bound<'py, PyArray1<f64>>);

pub(super) fn options(id: Option<u64>, tag: u64, payload: Option<&[u8]>) -> InsertOptions<'_> {
    let options = InsertOptions::new().tag(tag);
    let options = id.map_or(options, |id| options.id(id));
    options.payload(payload.unwrap_or_default())
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

    pub(crate) fn in_memory(
        py: Python<'_>,
        space: &wayfold::Space,
        is_inline: bool,
    ) -> PyResult<Index> {
        let index = match is_inline {
            true => wayfold::Index::in_memory_inline(space),
            false => wayfold::Index::in_memory(space),
        };
        Index::of(py, index.or_raise(py)?, Form::Memory { is_inline })
    }

    pub(super) fn one(&self, state: &Bound<'_, PyAny>) -> PyResult<Vec<f64>> {
        one_state(state, self.index.space(), self.names.bind(state.py()))
    }

    pub(crate) fn rows(&self, states: &Bound<'_, PyAny>) -> PyResult<Rows> {
        rows(states, self.index.space(), self.names.bind(states.py()))
    }

    /// Stores a state.
    pub(super) fn inserted(
        &self,
        state: &Bound<'_, PyAny>,
        options: InsertOptions<'_>,
    ) -> PyResult<wayfold::InsertedPoint> {
        let row = self.one(state)?;
        let inserted = self.call(state.py(), |index| index.insert_with(&row[..], options))?;
        self.gave(inserted.id);
        Ok(inserted)
    }

    pub(super) fn gave(&self, id: u64) {
        self.next_id.fetch_max(id + 1, Ordering::Relaxed);
    }

    /// Runs a call without the interpreter's lock.
    pub(crate) fn call<T: Send>(
        &self,
        py: Python<'_>,
        call: impl FnOnce(&wayfold::Index) -> Result<T, Error> + Send,
    ) -> PyResult<T> {
        py.detach(|| call(&self.index)).or_raise(py)
    }

    /// Raises in a process that was forked from the one that opened a shared index.
    pub(super) fn check_process(&self, py: Python<'_>) -> PyResult<()> {
        self.call(py, |index| match index.status() {
            Some(wayfold::ConnectionStatus::Ended { why }) if matches!(*why, Error::Forked) => {
                Err(Error::Forked)
            }
            _ => Ok(()),
        })
    }

    pub(super) fn found(
        &self,
        state: &Bound<'_, PyAny>,
        search: &wayfold::Search,
    ) -> PyResult<SearchResult> {
        let (py, row) = (state.py(), self.one(state)?);
        let found = self.call(py, |index| index.search(&row[..], search))?;
        Ok(SearchResult::of(
            py,
            &found.neighbors,
            found.read_revision.0,
        ))
    }

    /// Searches for the neighbours of many states.
    pub(super) fn found_many<'py>(
        &self,
        states: &Bound<'py, PyAny>,
        search: impl FnOnce(&wayfold::Index, ChunksExact<'_, f64>) -> Result<Vec<Vec<Neighbor>>, Error>
        + Send,
    ) -> PyResult<Vec<IdsAndDistances<'py>>> {
        let (py, rows) = (states.py(), self.rows(states)?);
        let rows = rows.numbers.chunks_exact(self.index.space().coordinates());
        let found = self.call(py, |index| search(index, rows))?;
        Ok(found.iter().map(|found| columns(py, found)).collect())
    }
}
