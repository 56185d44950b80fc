//! All points within a radius.

use std::ops::Range;

use wayfold_proto::v1::{self, neighbor_spec};

use super::{SearchOptions, awaitable, knn::neighbors, search_options};
use crate::{
    Error, Filter, Include, IndexHandle, Neighbors, Radius, States,
    net::{
        call::Call,
        limits::{self, READ_ROWS},
    },
};

/// Finds all points within a radius of each state, the closed ball, nearest first; await it to send it.
///
/// More than [`READ_ROWS`](crate::READ_ROWS) states, or more neighbours than an answer holds, are divided among several
/// calls, which may see different revisions: [`Neighbors::revision_of`]. Where the neighbours of a single state are
/// too many for an answer, that is `RESOURCE_EXHAUSTED`.
#[derive(Debug)]
#[must_use = "a request does nothing until it is awaited"]
pub struct Query {
    index: IndexHandle,
    states: Result<States, Error>,
    radius: Radius,
    options: SearchOptions,
}

awaitable!(Query => Neighbors);
search_options!(
    Query,
    "Points beyond radius / (1 + epsilon) may be missing; 0, exact, unless set."
);

impl Query {
    pub(crate) fn new(index: IndexHandle, states: Result<States, Error>, radius: Radius) -> Query {
        Query {
            index,
            states,
            radius,
            options: SearchOptions::default(),
        }
    }

    async fn send(mut self) -> Result<Neighbors, Error> {
        let states = std::mem::replace(&mut self.states, Ok(States::new(0)))?;
        limits::read(
            &self.index,
            states.len(),
            |limits| Ok(limits.max_rows_per_call.min(READ_ROWS)),
            |part| self.message(&states, part),
            |answer, part| {
                let (call, include) = (v1::QueryRequest::NAME, self.options.include);
                let found = (answer.neighbors, answer.revision);
                neighbors(call, &self.index, found, part.len(), include)
            },
            Neighbors::append,
        )
        .await
    }

    fn message(&self, states: &States, part: Range<usize>) -> v1::QueryRequest {
        v1::QueryRequest {
            index_name: self.index.name().to_owned(),
            states: Some(states.to_message(part)),
            radius_form: Some(neighbor_spec::RadiusForm::from(self.radius).into()),
            epsilon: self.options.epsilon,
            filter: self.options.filter.to_message(),
            include: self.options.include.to_message(),
            min_revision: self.index.min_revision(),
            latest: self.index.reads_latest(),
        }
    }
}
