//! The calls behind the methods of `Index`: states as rows, and calls without the interpreter's lock.

use std::{
    ffi::CString,
    slice::ChunksExact,
    sync::atomic::{AtomicU64, Ordering},
    time::Duration,
};

use pyo3::{
    exceptions::{PyOverflowError, PyRuntimeWarning},
    prelude::*,
    types::{PyList, PyTuple},
};
use wayfold::{Error, InsertOptions};

use super::Index;
use crate::{
    error::{OrRaise, raised},
    open::name_of,
    points::SearchResult,
    rows::{Rows, one_state, rows},
    space::names,
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

/// An id as an argument; `None` for one that no point has, as the −1 that [`Index::query`] answers where it finds none.
pub(super) struct GivenId(pub(super) Option<u64>);

impl FromPyObject<'_, '_> for GivenId {
    type Error = PyErr;

    fn extract(id: Borrowed<'_, '_, PyAny>) -> PyResult<GivenId> {
        match id.extract::<u64>() {
            Err(error) if error.is_instance_of::<PyOverflowError>(id.py()) => Ok(GivenId(None)),
            extracted => extracted.map(|id| GivenId(Some(id))),
        }
    }
}

pub(super) fn options(id: Option<u64>, tag: u64, payload: Option<&[u8]>) -> InsertOptions<'_> {
    let options = InsertOptions::new().tag(tag);
    let options = id.map_or(options, |id| options.id(id));
    options.payload(payload.unwrap_or_default())
}

/// Warns. A filter that turns warnings into exceptions does not replace an exception that is under way.
fn warn(py: Python<'_>, text: String) {
    let text = CString::new(text).unwrap_or_default();
    let warned = PyErr::warn(py, &py.get_type::<PyRuntimeWarning>(), &text, 1);
    if let Err(error) = warned {
        error.write_unraisable(py, None);
    }
}

impl Drop for Index {
    /// Warns of lost writes. Python shows no log lines of the Rust package. A closed index has no pending writes.
    fn drop(&mut self) {
        let count = match self.index.pending() {
            // A refusal leaves no write pending. After `take_unsent`, the index would open another session.
            0 => match self.index.close(Duration::ZERO).len() {
                0 => return,
                refused => format!("{refused} refused"),
            },
            pending => format!("{pending} pending"),
        };
        let text = format!(
            "a shared index was dropped before the server had acknowledged its writes ({count}): use it in a `with` block, \
             or call `flush` or `close`"
        );
        Python::try_attach(|py| {
            // An exception may be under way, and a warning needs that none is.
            let raised = PyErr::take(py);
            warn(py, text);
            if let Some(raised) = raised {
                raised.restore(py);
            }
        });
    }
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
        one_state(0, state, self.index.space(), self.names.bind(state.py()))
    }

    pub(crate) fn rows(&self, states: &Bound<'_, PyAny>) -> PyResult<Rows> {
        rows(0, states, self.index.space(), self.names.bind(states.py()))
    }

    /// The rows of a call that takes many states. An empty list has none: as an array it would be one state without numbers.
    pub(super) fn many_rows(&self, states: &Bound<'_, PyAny>) -> PyResult<Rows> {
        let is_empty = states.cast::<PyList>().is_ok_and(|list| list.is_empty())
            || states.cast::<PyTuple>().is_ok_and(|tuple| tuple.is_empty());
        match is_empty {
            true => Ok(Rows {
                numbers: Vec::new(),
                shape: vec![0],
            }),
            false => self.rows(states),
        }
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

    /// Ends a `with` block. An exception that ended it stays.
    pub(super) fn exit(&self, py: Python<'_>, has_raised: bool) -> PyResult<()> {
        // Tells the reason, if the writes cannot be sent. `close` has only the writes.
        let flushed = match has_raised {
            true => Ok(()),
            // An interrupt ends the block at once.
            false => self.wait(py, wayfold::Index::flush)?.or_raise(py),
        };
        let lost = match self.close(py, 30.0) {
            Ok(unsent) => unsent.len(),
            // The process was forked, and the writes are its parent's, or the wait was interrupted.
            Err(_) if has_raised => 0,
            Err(error) => return Err(error),
        };
        if lost == 0 {
            // `close` has waited for the writes for which `flush` had too little time.
            return Ok(());
        }
        if flushed.is_ok() {
            let text = format!(
                "a shared index was closed before the server had acknowledged its writes, which are lost ({lost}): call \
                 `flush` and `take_unsent` within the `with` block to keep them"
            );
            warn(py, text);
        }
        flushed
    }

    /// Runs a call that waits and has no error for an interrupt, without the interpreter's lock.
    pub(super) fn wait<T: Send>(
        &self,
        py: Python<'_>,
        call: impl FnOnce(&wayfold::Index) -> T + Send,
    ) -> PyResult<T> {
        self.check_process(py)?;
        let answer = py.detach(|| call(&self.index));
        match raised() {
            Some(error) => Err(error),
            None => Ok(answer),
        }
    }

    /// Runs a call without the interpreter's lock.
    pub(crate) fn call<T: Send>(
        &self,
        py: Python<'_>,
        call: impl FnOnce(&wayfold::Index) -> Result<T, Error> + Send,
    ) -> PyResult<T> {
        py.detach(|| call(&self.index)).or_raise(py)
    }

    /// Runs a call about a point; the default answer is that there is none.
    pub(super) fn of_point<T: Default + Send>(
        &self,
        py: Python<'_>,
        id: &GivenId,
        call: impl FnOnce(&wayfold::Index, u64) -> Result<T, Error> + Send,
    ) -> PyResult<T> {
        match id.0 {
            Some(id) => self.call(py, |index| call(index, id)),
            None => Ok(T::default()),
        }
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

    /// The encoding of payloads that the index declares.
    pub(super) fn declared_encoding(&self, py: Python<'_>) -> PyResult<Option<&'static str>> {
        self.check_process(py)?;
        Ok(name_of(py.detach(|| self.index.payload_encoding())))
    }

    pub(super) fn found(
        &self,
        state: &Bound<'_, PyAny>,
        search: &wayfold::Search,
    ) -> PyResult<SearchResult> {
        let (py, row) = (state.py(), self.one(state)?);
        let found = self.call(py, |index| index.search(&row[..], search))?;
        Ok(SearchResult::of(py, &found))
    }

    /// Searches for the neighbours of many states.
    pub(super) fn found_many(
        &self,
        states: &Bound<'_, PyAny>,
        search: impl FnOnce(
            &wayfold::Index,
            ChunksExact<'_, f64>,
        ) -> Result<Vec<wayfold::SearchResult>, Error>
        + Send,
    ) -> PyResult<Vec<SearchResult>> {
        let (py, rows) = (states.py(), self.many_rows(states)?);
        let rows = rows.numbers.chunks_exact(self.index.space().coordinates());
        let found = self.call(py, |index| search(index, rows))?;
        Ok(found
            .iter()
            .map(|found| SearchResult::of(py, found))
            .collect())
    }
}
