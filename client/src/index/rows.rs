//! The states that a caller gives as canonical rows, and the searches of these rows.

use std::cell::Cell;

use wayfold_index::{Neighbor, ReadRevision, ScaledSearch};

use super::{Index, SearchResult};
use crate::{Error, State, state};

thread_local! {
    /// The row of the state that this thread asks about. A state's `write` may use an index too: it gets a row of its
    /// own then.
    static ROW: Cell<Vec<f64>> = const { Cell::new(Vec::new()) };
}

impl Index {
    /// Runs `action` with the canonical row of a state.
    pub(super) fn with_row<S: State, T>(
        &self,
        state: S,
        action: impl FnOnce(&[f64]) -> Result<T, Error>,
    ) -> Result<T, Error> {
        state::check_layout::<S>(self.space(), &self.coordinates)?;
        // At the end of a thread its buffer is gone: destructors still search.
        let mut row = ROW.try_with(Cell::take).unwrap_or_default();
        row.clear();
        state.write(&mut row);
        let done = self.canonicalize(0, &mut row).and_then(|()| action(&row));
        let _ = ROW.try_with(|buffer| buffer.set(row));
        done
    }

    /// Runs `action` with the canonical rows of states, one after the other.
    pub(super) fn with_rows<S: State, T>(
        &self,
        states: impl IntoIterator<Item = S>,
        action: impl FnOnce(&[f64]) -> Result<T, Error>,
    ) -> Result<T, Error> {
        state::check_layout::<S>(self.space(), &self.coordinates)?;
        let mut rows = Vec::new();
        for (row, state) in states.into_iter().enumerate() {
            let start = rows.len();
            state.write(&mut rows);
            self.canonicalize(row, &mut rows[start..])?;
        }
        action(&rows)
    }

    /// Answers a search about a state into `found`.
    pub(super) fn ask(
        &self,
        state: impl State,
        scaled: &ScaledSearch<'_>,
        found: &mut Vec<Neighbor>,
    ) -> Result<ReadRevision, Error> {
        self.with_row(state, |row| self.form.search(row, scaled, found))
    }

    /// Answers searches about rows, one after the other.
    pub(super) fn ask_many(
        &self,
        rows: &[f64],
        searches: &[ScaledSearch<'_>],
    ) -> Result<Vec<SearchResult>, Error> {
        let found = self.form.search_many(rows, searches)?.into_iter();
        let found = found.map(|(neighbors, read_revision)| SearchResult {
            neighbors,
            read_revision,
        });
        Ok(found.collect())
    }

    fn canonicalize(&self, row: usize, numbers: &mut [f64]) -> Result<(), Error> {
        let (expected, found) = (self.coordinates.len(), numbers.len());
        if found != expected {
            return Err(Error::Width {
                row,
                expected,
                found,
            });
        }
        let canonical = self.space().canonicalize(numbers);
        canonical.map_err(|error| Error::State { row, error })
    }
}
