//! All points within a radius.

use std::ops::Range;

use wayfold_proto::v1::{self, neighbor_spec};

use super::{SearchOptions, awaitable, search_options};
use crate::{
    Error, Filter, Include, IndexHandle, Neighbors, Radius, States,
    net::limits::{self, READ_ROWS},
    net::neighbors::Expected,
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
        const CALL: &str = "query";
        let states = std::mem::replace(&mut self.states, Ok(States::new(0)))?;
        let (limits, mut deadline) = self.index.limits(CALL, states.len()).await?;
        let max_rows = limits.max_rows_per_call.min(READ_ROWS);
        let (this, states) = (&self, &states);
        let read = |part: Range<usize>| {
            let deadline = deadline.take();
            async move {
                let message = || this.message(states, part.clone());
                let answer = this
                    .index
                    .call(CALL, deadline, message, |mut stub, request| async move {
                        stub.query(request).await
                    })
                    .await?;
                let expected = Expected {
                    call: CALL,
                    rows: part.len(),
                    width: this.index.coordinates(),
                    include: this.options.include,
                    revision: this.index.answered(CALL, answer.revision)?,
                };
                Neighbors::from_message(answer.neighbors, expected)
            }
        };
        limits::read_in_parts(states.len(), max_rows, read, Neighbors::append).await
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
