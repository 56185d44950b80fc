//! The neighbours of several states.

use bytes::Bytes;
use wayfold_proto::v1;

use crate::{Error, States, read::Revisions};

/// The neighbours of each state that was asked about, nearest first; at equal distances by id.
#[derive(Clone, Debug, PartialEq)]
pub struct Neighbors {
    /// Where the neighbours of each state end in the columns.
    ends: Vec<usize>,
    ids: Vec<u64>,
    distances: Vec<f64>,
    states: Option<States>,
    tags: Option<Vec<u64>>,
    stored: Option<Vec<u64>>,
    payloads: Option<Vec<Bytes>>,
    exact: bool,
    seen: Revisions,
    uid: String,
}

/// The neighbours of one state, in columns.
#[derive(Clone, Copy, Debug)]
pub struct Row<'a> {
    /// Their ids.
    pub ids: &'a [u64],
    /// Their distances in the space's metric, ascending; as many as `ids`.
    pub distances: &'a [f64],
    /// Their tags, if they were asked for; as many as `ids`.
    pub tags: Option<&'a [u64]>,
    /// The revisions that stored their states, if they were asked for; as many as `ids`.
    pub revisions: Option<&'a [u64]>,
    /// Their payloads, if they were asked for; as many as `ids`, empty where a point has none.
    pub payloads: Option<&'a [Bytes]>,
    states: Option<&'a States>,
    start: usize,
}

impl<'a> Row<'a> {
    /// How many neighbours there are.
    pub fn len(&self) -> usize {
        self.ids.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.ids.is_empty()
    }

    /// The id and distance of each neighbour, nearest first.
    pub fn iter(&self) -> impl Iterator<Item = (u64, f64)> + use<'a> {
        self.ids.iter().copied().zip(self.distances.iter().copied())
    }

    /// The state of neighbour `i` in canonical form, if states were asked for and there is such a neighbour.
    pub fn state(&self, i: usize) -> Option<&'a [f64]> {
        let states = self.states?;
        (i < self.len()).then(|| states.row(self.start + i))
    }
}

impl Neighbors {
    /// How many states were asked about.
    pub fn len(&self) -> usize {
        self.ends.len()
    }

    /// Whether none was.
    pub fn is_empty(&self) -> bool {
        self.ends.is_empty()
    }

    /// The neighbours of state `i`.
    ///
    /// # Panics
    /// If there is no such state.
    pub fn row(&self, i: usize) -> Row<'_> {
        let start = if i == 0 { 0 } else { self.ends[i - 1] };
        let range = start..self.ends[i];
        Row {
            ids: &self.ids[range.clone()],
            distances: &self.distances[range.clone()],
            tags: self.tags.as_ref().map(|tags| &tags[range.clone()]),
            revisions: self.stored.as_ref().map(|stored| &stored[range.clone()]),
            payloads: self.payloads.as_ref().map(|payloads| &payloads[range]),
            states: self.states.as_ref(),
            start,
        }
    }

    /// The neighbours of each state, in the order of the states.
    pub fn rows(&self) -> impl ExactSizeIterator<Item = Row<'_>> {
        (0..self.len()).map(|i| self.row(i))
    }

    /// Whether all of it equals brute force: false only if `epsilon` or `max_leaves` may have cost an answer.
    pub fn exact(&self) -> bool {
        self.exact
    }

    /// The revision that was read; the oldest one where the request was divided among several calls, so that nothing
    /// stored up to it is missing from any row.
    pub fn revision(&self) -> u64 {
        self.seen.oldest()
    }

    /// The revision at which the neighbours of state `i` were read.
    pub fn revision_of(&self, i: usize) -> u64 {
        self.seen.of_row(i)
    }

    /// The uid of the index, to which the revisions belong.
    pub fn uid(&self) -> &str {
        &self.uid
    }

    /// The answer to a call about `rows` states, checked.
    pub(crate) fn from_message(
        message: Option<v1::Neighbors>,
        told: Told<'_>,
        width: usize,
    ) -> Result<Neighbors, Error> {
        let call = told.call;
        let wrong = |problem: &str| Error::Protocol {
            call,
            problem: problem.to_owned(),
        };
        let message = message.unwrap_or_default();
        if told.rows != message.counts.len() {
            return Err(wrong("not as many counts as states"));
        }
        let mut ends = Vec::with_capacity(message.counts.len());
        let mut found = 0_usize;
        for count in message.counts {
            found = found.saturating_add(count as usize);
            ends.push(found);
        }
        if message.ids.len() != found || message.distances.len() != found {
            return Err(wrong("counts, ids and distances disagree"));
        }
        let include = told.include;
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
        Ok(Neighbors {
            seen: Revisions::one(ends.len(), told.revision),
            ends,
            ids: message.ids,
            distances: message.distances,
            states,
            tags: include.tags.then_some(tags),
            stored: include.revisions.then_some(stored),
            payloads: include.payloads.then_some(payloads),
            exact: told.exact,
            uid: told.uid.to_owned(),
        })
    }

    /// Puts the answer to later rows of the same request behind this one.
    pub(crate) fn append(&mut self, other: Neighbors) {
        let before = self.ids.len();
        self.ends
            .extend(other.ends.into_iter().map(|end| before + end));
        self.ids.extend(other.ids);
        self.distances.extend(other.distances);
        if let (Some(states), Some(others)) = (&mut self.states, other.states) {
            states.append(others);
        }
        extend(&mut self.tags, other.tags);
        extend(&mut self.stored, other.stored);
        extend(&mut self.payloads, other.payloads);
        self.exact &= other.exact;
        self.seen.append(other.seen);
    }
}

fn extend<T>(column: &mut Option<Vec<T>>, other: Option<Vec<T>>) {
    if let (Some(column), Some(other)) = (column, other) {
        column.extend(other);
    }
}

/// What is known of an answer beside its neighbours.
#[derive(Clone, Copy)]
pub(crate) struct Told<'a> {
    pub(crate) call: &'static str,
    /// How many states were asked about.
    pub(crate) rows: usize,
    pub(crate) include: crate::Include,
    pub(crate) exact: bool,
    pub(crate) revision: u64,
    pub(crate) uid: &'a str,
}
