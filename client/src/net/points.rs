//! Stored points, in columns.

use bytes::Bytes;
use wayfold_proto::v1;

use crate::{Error, FromState, Include, Revision, States, net::revision::RowRevisions};

/// Stored points, in the order of a get's ids, or in that of all ids.
#[derive(Clone, Debug, PartialEq)]
pub struct Points {
    ids: Vec<u64>,
    states: Option<States>,
    tags: Option<Vec<u64>>,
    stored: Option<Vec<u64>>,
    payloads: Option<Vec<Bytes>>,
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
        self.ids.len()
    }

    /// True if there are none.
    pub fn is_empty(&self) -> bool {
        self.ids.is_empty()
    }

    /// Point `i`.
    ///
    /// # Panics
    /// If there is no such point.
    pub fn point(&self, i: usize) -> Point<'_> {
        Point {
            id: self.ids[i],
            state: self.states.as_ref().map_or(&[], |states| states.row(i)),
            tag: self.tags.as_ref().map_or(0, |tags| tags[i]),
            revision: self.stored.as_ref().map_or(0, |stored| stored[i]),
            payload: self.payloads.as_ref().map(|payloads| &payloads[i]),
        }
    }

    /// All points, in order.
    pub fn iter(&self) -> impl ExactSizeIterator<Item = Point<'_>> {
        (0..self.len()).map(|i| self.point(i))
    }

    /// The ids.
    pub fn ids(&self) -> &[u64] {
        &self.ids
    }

    /// The states in canonical form, if included.
    pub fn states(&self) -> Option<&States> {
        self.states.as_ref()
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
        let wrong = |problem: &str| Error::Protocol {
            call,
            problem: problem.to_owned(),
        };
        let message = message.unwrap_or_default();
        let found = message.ids.len();
        let states = match include.states {
            true => Some(
                States::from_message(message.states, found, width)
                    .ok_or_else(|| wrong("not a state for each id"))?,
            ),
            false => None,
        };
        let (tags, stored, payloads) = (message.tags, message.revisions, message.payloads);
        if include.tags && tags.len() != found
            || include.revisions && stored.len() != found
            || include.payloads && payloads.len() != found
        {
            return Err(wrong("not a tag, revision or payload for each id"));
        }
        Ok(Points {
            ids: message.ids,
            states,
            tags: include.tags.then_some(tags),
            stored: include.revisions.then_some(stored),
            payloads: include.payloads.then_some(payloads),
            read_at: RowRevisions::one(found, revision),
        })
    }

    /// Appends the answer to later ids of the same request.
    pub(crate) fn append(&mut self, other: Points) {
        self.ids.extend(other.ids);
        if let (Some(states), Some(others)) = (&mut self.states, other.states) {
            states.append(others);
        }
        extend(&mut self.tags, other.tags);
        extend(&mut self.stored, other.stored);
        extend(&mut self.payloads, other.payloads);
        self.read_at.append(other.read_at);
    }
}

/// Appends a column that both answers have.
pub(crate) fn extend<T>(column: &mut Option<Vec<T>>, other: Option<Vec<T>>) {
    if let (Some(column), Some(other)) = (column, other) {
        column.extend(other);
    }
}
