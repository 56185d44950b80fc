//! The neighbours of several states.

use bytes::Bytes;
use wayfold_index::Neighbor;
use wayfold_proto::v1;

use crate::{
    Error, Include, Revision, States,
    net::{columns::Columns, revision::RowRevisions},
};

/// The neighbours of each state of a request, nearest first; at equal distances by id.
#[derive(Clone, Debug, PartialEq)]
pub struct Neighbors {
    /// The end of each state's neighbours in the columns.
    ends: Vec<usize>,
    distances: Vec<f64>,
    columns: Columns,
    read_at: RowRevisions,
}

/// The neighbours of one state, in columns.
#[derive(Clone, Copy, Debug)]
pub struct StateNeighbors<'a> {
    ids: &'a [u64],
    distances: &'a [f64],
    tags: Option<&'a [u64]>,
    revisions: Option<&'a [u64]>,
    payloads: Option<&'a [Bytes]>,
    states: Option<&'a States>,
    start: usize,
}

impl<'a> StateNeighbors<'a> {
    /// The number of neighbours.
    pub fn len(&self) -> usize {
        self.ids.len()
    }

    /// True if there are none.
    pub fn is_empty(&self) -> bool {
        self.ids.is_empty()
    }

    /// The nearest neighbour.
    pub fn nearest(&self) -> Option<Neighbor> {
        self.iter().next()
    }

    /// The ids, nearest first.
    pub fn ids(&self) -> impl ExactSizeIterator<Item = u64> + use<'a> {
        self.ids.iter().copied()
    }

    /// The distances in the space's metric, ascending.
    pub fn distances(&self) -> impl ExactSizeIterator<Item = f64> + use<'a> {
        self.distances.iter().copied()
    }

    /// The id and distance of each neighbour, nearest first.
    pub fn iter(&self) -> impl ExactSizeIterator<Item = Neighbor> + use<'a> {
        let pairs = self.ids.iter().zip(self.distances);
        pairs.map(|(&id, &distance)| Neighbor { distance, id })
    }

    /// The tags, one a neighbour, if included.
    pub fn tags(&self) -> Option<&'a [u64]> {
        self.tags
    }

    /// The numbers of the revisions that stored the states, one a neighbour, if included.
    pub fn revisions(&self) -> Option<&'a [u64]> {
        self.revisions
    }

    /// The payloads, one a neighbour and empty for a point without one, if included.
    pub fn payloads(&self) -> Option<&'a [Bytes]> {
        self.payloads
    }

    /// The state of neighbour `i` in canonical form, if states are included and there is such a neighbour.
    pub fn state(&self, i: usize) -> Option<&'a [f64]> {
        let states = self.states?;
        (i < self.len()).then(|| states.row(self.start + i))
    }
}

impl Neighbors {
    /// The number of states in the request.
    pub fn len(&self) -> usize {
        self.ends.len()
    }

    /// True if the request had no states.
    pub fn is_empty(&self) -> bool {
        self.ends.is_empty()
    }

    /// The neighbours of state `i`.
    ///
    /// # Panics
    /// If there is no such state.
    pub fn row(&self, i: usize) -> StateNeighbors<'_> {
        let start = if i == 0 { 0 } else { self.ends[i - 1] };
        let range = start..self.ends[i];
        let columns = &self.columns;
        StateNeighbors {
            ids: &columns.ids[range.clone()],
            distances: &self.distances[range.clone()],
            tags: columns.tags.as_ref().map(|tags| &tags[range.clone()]),
            revisions: columns.stored.as_ref().map(|stored| &stored[range.clone()]),
            payloads: columns.payloads.as_ref().map(|payloads| &payloads[range]),
            states: columns.states.as_ref(),
            start,
        }
    }

    /// The neighbours of each state, in the order of the states.
    pub fn rows(&self) -> impl ExactSizeIterator<Item = StateNeighbors<'_>> {
        (0..self.len()).map(|i| self.row(i))
    }

    /// The revision that was read. If the request was divided among several calls, it is the oldest one, so that no row
    /// misses a point that was stored up to it.
    pub fn revision(&self) -> Revision {
        self.read_at.oldest()
    }

    /// The revision at which the neighbours of state `i` were read.
    ///
    /// # Panics
    /// If there is no such state.
    pub fn revision_of(&self, i: usize) -> Revision {
        self.read_at.of_row(i)
    }

    /// The answer to a call about `rows` states of `width` coordinates, checked.
    pub(crate) fn from_message(
        call: &'static str,
        message: Option<v1::Neighbors>,
        revision: Revision,
        (rows, width): (usize, usize),
        include: Include,
    ) -> Result<Neighbors, Error> {
        let wrong = |problem: &str| Error::protocol(call, problem);
        let message = message.unwrap_or_default();
        if rows != message.neighbor_counts.len() {
            return Err(wrong("not as many neighbor_counts as states"));
        }
        let mut ends = Vec::with_capacity(message.neighbor_counts.len());
        let mut found = 0_usize;
        for count in message.neighbor_counts {
            found = found.saturating_add(count as usize);
            ends.push(found);
        }
        if message.ids.len() != found || message.distances.len() != found {
            return Err(wrong("neighbor_counts, ids and distances disagree"));
        }
        let points = v1::Points {
            ids: message.ids,
            states: message.states,
            tags: message.tags,
            revisions: message.revisions,
            payloads: message.payloads,
        };
        Ok(Neighbors {
            read_at: RowRevisions::one(ends.len(), revision),
            ends,
            distances: message.distances,
            columns: Columns::from_message(call, points, width, include)?,
        })
    }

    /// Appends the answer to later rows of the same request.
    pub(crate) fn append(&mut self, other: Neighbors) {
        let before = self.distances.len();
        self.ends
            .extend(other.ends.into_iter().map(|end| before + end));
        self.distances.extend(other.distances);
        self.columns.append(other.columns);
        self.read_at.append(other.read_at);
    }
}
