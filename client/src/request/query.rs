//! All points within a radius.

use std::ops::Range;

use wayfold_index::{Filter, Scaling};
use wayfold_proto::v1;

use super::{SearchOptions, awaitable, scaling::scaling_message, search_options};
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
    radius_factor: Option<f64>,
    options: SearchOptions,
}

awaitable!(Query => Neighbors);
search_options!(
    Query,
    "Points beyond radius / (1 + epsilon) may be missing; 0, exact, unless set."
);

impl Query {
    pub(crate) fn new(index: IndexHandle, states: Result<States, Error>, radius: f64) -> Query {
        Query {
            index,
            states,
            radius,
            radius_factor: None,
            options: SearchOptions::default(),
        }
    }

    /// Scales the radius: factor · (ln n / n)^(1/d), but at most the radius given, which may be infinite, for n points at the
    /// revision that is read. The server evaluates it, so that workers need not agree on n. See
    /// [`Scaling::radius_factor`].
    pub fn radius_scaled(mut self, factor: f64) -> Query {
        self.radius_factor = Some(factor);
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
                include: this.options.include,
                exact: answer.exact,
                revision: answer.revision,
                uid: &answer.uid,
            };
            Neighbors::from_message(answer.neighbors, told, this.index.coordinates())
        };
        limits::read_in_parts(states.len(), READ_ROWS, read, Neighbors::append).await
    }

    fn message(&self, states: &States, part: Range<usize>) -> v1::QueryRequest {
        let scaling = Scaling {
            radius_factor: self.radius_factor,
            radius_max: self.radius_factor.and(Some(self.radius)),
            ..Scaling::default()
        };
        v1::QueryRequest {
            index: self.index.name().to_owned(),
            states: Some(states.to_message(part)),
            radius: scaling.is_none().then_some(self.radius),
            epsilon: self.options.epsilon,
            max_leaves: self.options.max_leaves,
            filter: filter_message(self.options.filter),
            include: self.options.include.to_message(),
            at: Some(self.index.read_at()),
            scaling: scaling_message(scaling),
        }
    }
}
