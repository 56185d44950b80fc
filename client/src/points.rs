//! Stored points, in columns.

use bytes::Bytes;
use wayfold_proto::v1;

use crate::{Error, FromState, States, read::Revisions};

/// Stored points, in the order of the ids that were asked for, or of a scan.
#[derive(Clone, Debug, PartialEq)]
pub struct Points {
    ids: Vec<u64>,
    states: States,
    tags: Vec<u64>,
    stored: Vec<u64>,
    payloads: Option<Vec<Bytes>>,
    seen: Revisions,
}

/// One stored point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Point<'a> {
    /// Its id.
    pub id: u64,
    /// Its state, in canonical form.
    pub state: &'a [f64],
    /// Its tag.
    pub tag: u64,
    /// The revision that stored its state.
    pub revision: u64,
    /// Its payload, if payloads were asked for; empty if it has none.
    pub payload: Option<&'a Bytes>,
}

impl Point<'_> {
    /// The state as a type that has as many numbers, `None` if it has others.
    pub fn state_as<S: FromState>(&self) -> Option<S> {
        S::from_state(self.state)
    }
}

impl Points {
    /// How many points there are.
    pub fn len(&self) -> usize {
        self.ids.len()
    }

    /// Whether there are none.
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
            state: self.states.row(i),
            tag: self.tags[i],
            revision: self.stored[i],
            payload: self.payloads.as_ref().map(|payloads| &payloads[i]),
        }
    }

    /// All of them, in order.
    pub fn iter(&self) -> impl ExactSizeIterator<Item = Point<'_>> {
        (0..self.len()).map(|i| self.point(i))
    }

    /// The ids.
    pub fn ids(&self) -> &[u64] {
        &self.ids
    }

    /// The states, in canonical form.
    pub fn states(&self) -> &States {
        &self.states
    }

    /// The revision that was read; the oldest one where the request was divided among several calls.
    pub fn revision(&self) -> u64 {
        self.seen.oldest()
    }

    pub(crate) fn from_message(
        call: &'static str,
        message: Option<v1::Points>,
        revision: u64,
        width: usize,
        payloads: bool,
    ) -> Result<Points, Error> {
        let wrong = |problem: &str| Error::Protocol {
            call,
            problem: problem.to_owned(),
        };
        let message = message.unwrap_or_default();
        let found = message.ids.len();
        let states = States::from_message(message.states, found, width)
            .ok_or_else(|| wrong("not a state for each id"))?;
        if message.tags.len() != found
            || message.revisions.len() != found
            || payloads && message.payloads.len() != found
        {
            return Err(wrong("not a tag, revision or payload for each id"));
        }
        Ok(Points {
            ids: message.ids,
            states,
            tags: message.tags,
            stored: message.revisions,
            payloads: payloads.then_some(message.payloads),
            seen: Revisions::one(found, revision),
        })
    }

    /// Puts the answer to later ids of the same request behind this one.
    pub(crate) fn append(&mut self, other: Points) {
        self.ids.extend(other.ids);
        self.states.append(other.states);
        self.tags.extend(other.tags);
        self.stored.extend(other.stored);
        if let (Some(payloads), Some(others)) = (&mut self.payloads, other.payloads) {
            payloads.extend(others);
        }
        self.seen.append(other.seen);
    }
}
