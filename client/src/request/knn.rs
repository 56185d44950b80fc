//! The k nearest points.

use std::ops::Range;

use wayfold_index::{Filter, Scaling};
use wayfold_proto::v1;

use super::{
    SearchOptions, awaitable,
    scaling::{most_neighbors, scaling_message},
    search_options,
};
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
    scaling: Scaling,
    pub(super) options: SearchOptions,
}

awaitable!(Knn => Neighbors);
search_options!(
    Knn,
    "Answers may be farther than the true ones by a factor of 1 + epsilon; 0, exact, unless set."
);

impl Knn {
    pub(crate) fn new(index: IndexHandle, states: Result<States, Error>) -> Knn {
        Knn {
            index,
            states,
            k: 1,
            radius: None,
            scaling: Scaling::default(),
            options: SearchOptions::default(),
        }
    }

    /// At most so many for each state, at least 1; 1 unless set.
    pub fn k(mut self, k: u32) -> Knn {
        self.k = k;
        self.scaling.k_factor = None;
        self
    }

    /// In the place of `k`: ⌈factor · ln n⌉, for n points at the revision that is read. The server evaluates it, so that
    /// workers need not agree on n. [`Scaling::K_FACTOR`] is what PRM* takes.
    pub fn k_scaled(mut self, factor: f64) -> Knn {
        self.k = 0;
        self.scaling.k_factor = Some(factor);
        self
    }

    /// Only those at this distance or nearer.
    pub fn radius(mut self, radius: f64) -> Knn {
        self.radius = Some(radius);
        (self.scaling.radius_factor, self.scaling.radius_max) = (None, None);
        self
    }

    /// In the place of `radius`: factor · (ln n / n)^(1/d), but at most `radius_max`, for n points at the revision that is
    /// read; evaluated by the server. See [`Scaling::radius_factor`].
    pub fn radius_scaled(mut self, factor: f64, radius_max: Option<f64>) -> Knn {
        self.radius = None;
        (self.scaling.radius_factor, self.scaling.radius_max) = (Some(factor), radius_max);
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
                this.options.include,
                this.index.coordinates(),
            )
        };
        limits::read_in_parts(states.len(), self.rows_of_answer(), read, Neighbors::append).await
    }

    /// How many states' neighbours one answer holds.
    fn rows_of_answer(&self) -> usize {
        const COUNT: usize = 5;
        let neighbor = self
            .options
            .include
            .neighbor_bytes(self.index.coordinates());
        let k = most_neighbors(Some(self.k), self.scaling).unwrap_or(usize::MAX);
        let row = neighbor.saturating_mul(k).saturating_add(COUNT);
        limits::rows_of_answer(self.index.client().max_message_bytes(), row, READ_ROWS)
    }

    pub(super) fn message(&self, states: &States, part: Range<usize>) -> v1::KnnRequest {
        v1::KnnRequest {
            index: self.index.name().to_owned(),
            states: Some(states.to_message(part)),
            k: self.k,
            radius: self.radius,
            epsilon: self.options.epsilon,
            max_leaves: self.options.max_leaves,
            filter: filter_message(self.options.filter),
            include: self.options.include.to_message(),
            at: Some(self.index.read_at()),
            scaling: scaling_message(self.scaling),
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
