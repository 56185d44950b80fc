//! The k nearest points.

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

/// Finds the nearest points of each state; await it to send it.
///
/// More states than [`READ_ROWS`](crate::READ_ROWS), or neighbours than an answer holds, are divided among several
/// calls, which may see different revisions: [`Neighbors::revision_of`].
#[derive(Debug)]
#[must_use = "a request does nothing until it is awaited"]
pub struct Knn {
    pub(super) index: IndexHandle,
    pub(super) states: Result<States, Error>,
    k: u32,
    radius: Option<f64>,
    epsilon: f64,
    max_leaves: u32,
    filter: Filter,
    pub(super) include: Include,
}

awaitable!(Knn => Neighbors);

impl Knn {
    pub(crate) fn new(index: IndexHandle, states: Result<States, Error>) -> Knn {
        Knn {
            index,
            states,
            k: 1,
            radius: None,
            epsilon: 0.0,
            max_leaves: 0,
            filter: Filter::default(),
            include: Include::default(),
        }
    }

    /// At most so many for each state, at least 1; 1 unless set.
    pub fn k(mut self, k: u32) -> Knn {
        self.k = k;
        self
    }

    /// Only those at this distance or nearer.
    pub fn radius(mut self, radius: f64) -> Knn {
        self.radius = Some(radius);
        self
    }

    /// Answers may be farther than the true ones by a factor of 1 + epsilon; 0, exact, unless set.
    pub fn epsilon(mut self, epsilon: f64) -> Knn {
        self.epsilon = epsilon;
        self
    }

    /// Visits at most so many leaves of the trees for each state; as many as exactness needs unless set.
    pub fn max_leaves(mut self, leaves: u32) -> Knn {
        self.max_leaves = leaves;
        self
    }

    /// Only some of the points.
    pub fn filter(mut self, filter: Filter) -> Knn {
        self.filter = filter;
        self
    }

    /// What to tell of each neighbour beside its id and distance.
    pub fn include(mut self, include: Include) -> Knn {
        self.include = include;
        self
    }

    async fn send(mut self) -> Result<Neighbors, Error> {
        const CALL: &str = "knn";
        let states = std::mem::replace(&mut self.states, Ok(States::new(0)))?;
        let (this, states) = (&self, &states);
        let read = |part: Range<usize>| async move {
            let message = || this.message(states, part.clone());
            let answer = this
                .index
                .call(CALL, message, |mut stub, request| async move {
                    stub.knn(request).await
                })
                .await?;
            this.index.told(&answer.uid, answer.revision);
            answered(
                CALL,
                answer,
                part.len(),
                this.include,
                this.index.coordinates(),
            )
        };
        limits::read_in_parts(states.len(), self.rows_of_answer(), read, Neighbors::append).await
    }

    /// How many states' neighbours one answer holds.
    fn rows_of_answer(&self) -> usize {
        const COUNT: usize = 5;
        let neighbor = self.include.neighbor_bytes(self.index.coordinates());
        let row = neighbor
            .saturating_mul(self.k as usize)
            .saturating_add(COUNT);
        limits::rows_of_answer(self.index.client().max_message_bytes(), row, READ_ROWS)
    }

    pub(super) fn message(&self, states: &States, part: Range<usize>) -> v1::KnnRequest {
        v1::KnnRequest {
            index: self.index.name().to_owned(),
            states: Some(states.to_message(part)),
            k: self.k,
            radius: self.radius,
            epsilon: self.epsilon,
            max_leaves: self.max_leaves,
            filter: filter_message(self.filter),
            include: self.include.to_message(),
            at: Some(self.index.read_at()),
        }
    }
}

/// The answer to a request about `rows` states.
pub(super) fn answered(
    call: &'static str,
    answer: v1::KnnResponse,
    rows: usize,
    include: Include,
    coordinates: usize,
) -> Result<Neighbors, Error> {
    let told = Told {
        call,
        rows,
        include,
        exact: answer.exact,
        revision: answer.revision,
        uid: &answer.uid,
    };
    Neighbors::from_message(answer.neighbors, told, coordinates)
}
