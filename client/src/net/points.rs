//! Stored points, in columns.

use bytes::Bytes;
use wayfold_proto::v1;

use crate::{
    Error, FromState, Include, Revision, States,
    net::{columns::Columns, revision::RowRevisions},
};

/// Stored points, in the order of a get's ids, or in that of all ids.
#[derive(Clone, Debug, PartialEq)]
pub struct Points {
    columns: Columns,
    read_at: RowRevisions,
}

/// One stored point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Point<'a> {
    /// Its id.
    pub id: u64,
    /// Its state, in canonical form; empty if states are not included.
    pub state: &'a [f64],
    /// Its tag; 0 if tags are not included.
    pub tag: u64,
    /// The number of the revision that stored its state; 0 if revisions are not included.
    pub revision: u64,
    /// Its payload, if payloads are included; empty if it has none.
    pub payload: Option<&'a Bytes>,
}

impl Point<'_> {
    /// The state as a type of the same number of coordinates; `None` if the numbers differ.
    pub fn state_as<S: FromState>(&self) -> Option<S> {
        S::from_state(self.state)
    }
}

impl Points {
    /// The number of points.
    pub fn len(&self) -> usize {
        self.columns.ids.len()
    }

    /// True if there are none.
    pub fn is_empty(&self) -> bool {
        self.columns.ids.is_empty()
    }

    /// Point `i`.
    ///
    /// # Panics
    /// If there is no such point.
    pub fn point(&self, i: usize) -> Point<'_> {
        let columns = &self.columns;
        Point {
            id: columns.ids[i],
            state: columns.states.as_ref().map_or(&[], |states| states.row(i)),
            tag: columns.tags.as_ref().map_or(0, |tags| tags[i]),
            revision: columns.stored.as_ref().map_or(0, |stored| stored[i]),
            payload: columns.payloads.as_ref().map(|payloads| &payloads[i]),
        }
    }

    /// All points, in order.
    pub fn iter(&self) -> impl ExactSizeIterator<Item = Point<'_>> {
        (0..self.len()).map(|i| self.point(i))
    }

    /// The ids.
    pub fn ids(&self) -> &[u64] {
        &self.columns.ids
    }

    /// The states in canonical form, if included.
    pub fn states(&self) -> Option<&States> {
        self.columns.states.as_ref()
    }

    /// The revision that was read; the oldest one if the request was divided among several calls.
    pub fn revision(&self) -> Revision {
        self.read_at.oldest()
    }

    /// The points of an answer, checked.
    pub(crate) fn from_message(
        call: &'static str,
        message: Option<v1::Points>,
        revision: Revision,
        width: usize,
        include: Include,
    ) -> Result<Points, Error> {
        let columns = Columns::from_message(call, message.unwrap_or_default(), width, include)?;
        Ok(Points {
            read_at: RowRevisions::one(columns.ids.len(), revision),
            columns,
        })
    }

    /// Appends the answer to later ids of the same request.
    pub(crate) fn append(&mut self, other: Points) {
        self.columns.append(other.columns);
        self.read_at.append(other.read_at);
    }
}
