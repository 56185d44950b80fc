//! All points within a radius.

use std::ops::Range;

use wayfold_index::Filter;
use wayfold_proto::v1;

use super::awaitable;
use crate::{
    Error, Include, IndexHandle, Neighbors, States,
    limits::{self, READ_ROWS},
    neighbors::Told,
    read::filter_message,
};

/// Finds all points within a radius of each state, the closed ball, nearest first; await it to send it.
///
/// More states than [`READ_ROWS`](crate::READ_ROWS), or neighbours than an answer holds, are divided among several
/// calls, which may see different revisions: [`Neighbors::revision_of`]. Where the neighbours of a single state are
/// too many for an answer, that is `RESOURCE_EXHAUSTED`.
#[derive(Debug)]
#[must_use = "a request does nothing until it is awaited"]
pub struct Query {
    index: IndexHandle,
    states: Result<States, Error>,
    radius: f64,
    epsilon: f64,
    max_leaves: u32,
    filter: Filter,
    include: Include,
}

awaitable!(Query => Neighbors);

impl Query {
    pub(crate) fn new(index: IndexHandle, states: Result<States, Error>, radius: f64) -> Query {
        Query {
            index,
            states,
            radius,
            epsilon: 0.0,
            max_leaves: 0,
            filter: Filter::default(),
            include: Include::default(),
        }
    }

    /// Points beyond radius / (1 + epsilon) may be missing; 0, exact, unless set.
    pub fn epsilon(mut self, epsilon: f64) -> Query {
        self.epsilon = epsilon;
        self
    }

    /// Visits at most so many leaves of the trees for each state; as many as exactness needs unless set.
    pub fn max_leaves(mut self, leaves: u32) -> Query {
        self.max_leaves = leaves;
        self
    }

    /// Only some of the points.
    pub fn filter(mut self, filter: Filter) -> Query {
        self.filter = filter;
        self
    }

    /// What to tell of each neighbour beside its id and distance.
    pub fn include(mut self, include: Include) -> Query {
        self.include = include;
        self
    }

    async fn send(mut self) -> Result<Neighbors, Error> {
        const CALL: &str = "query";
        let states = std::mem::replace(&mut self.states, Ok(States::new(0)))?;
        let (this, states) = (&self, &states);
        let read = |part: Range<usize>| async move {
            let message = || this.message(states, part.clone());
            let answer = this
                .index
                .call(CALL, message, |mut stub, request| async move {
                    stub.query(request).await
                })
                .await?;
            this.index.told(&answer.uid, answer.revision);
            let told = Told {
                call: CALL,
                rows: part.len(),
                include: this.include,
                exact: answer.exact,
                revision: answer.revision,
                uid: &answer.uid,
            };
            Neighbors::from_message(answer.neighbors, told, this.index.coordinates())
        };
        limits::read_in_parts(states.len(), READ_ROWS, read, Neighbors::append).await
    }

    fn message(&self, states: &States, part: Range<usize>) -> v1::QueryRequest {
        v1::QueryRequest {
            index: self.index.name().to_owned(),
            states: Some(states.to_message(part)),
            radius: self.radius,
            epsilon: self.epsilon,
            max_leaves: self.max_leaves,
            filter: filter_message(self.filter),
            include: self.include.to_message(),
            at: Some(self.index.read_at()),
        }
    }
}
