//! The k nearest points.

use std::ops::Range;

use wayfold_proto::v1::{self, neighbor_spec};

use super::{SearchOptions, awaitable, search_options};
use crate::{
    Error, Filter, Include, IndexHandle, Limits, Neighbors, Radius, States,
    net::{
        call::Call,
        limits::{self, READ_ROWS},
    },
    search::{Bounds, K},
};

/// Finds the nearest points of each state; await it to send it.
///
/// More than [`READ_ROWS`](crate::READ_ROWS) states, or more neighbours than an answer holds, are divided among several
/// calls, which may see different revisions: [`Neighbors::revision_of`].
#[derive(Debug)]
#[must_use = "a request does nothing until it is awaited"]
pub struct Knn {
    pub(super) index: IndexHandle,
    pub(super) states: Result<States, Error>,
    bounds: Bounds,
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
            bounds: Bounds {
                k: Some(K::Fixed(1)),
                radius: None,
            },
            options: SearchOptions::default(),
        }
    }

    /// At most `k` neighbours of each state, at least 1; 1 unless set.
    pub fn k(mut self, k: u32) -> Knn {
        self.bounds.k = Some(K::Fixed(k));
        self
    }

    /// At most ⌈factor · ln n⌉ neighbours, at least 1, for an index of n points; in the place of `k`. The server
    /// evaluates it, so that workers need not agree on n. PRM* takes [`Scaling::K_FACTOR`](crate::Scaling::K_FACTOR).
    pub fn k_factor(mut self, factor: f64) -> Knn {
        self.bounds.k = Some(K::Scaled(factor));
        self
    }

    /// Only those at distance `radius` or nearer: a number, or a [`ScaledRadius`](crate::ScaledRadius).
    pub fn radius(mut self, radius: impl Into<Radius>) -> Knn {
        self.bounds.radius = Some(radius.into());
        self
    }

    async fn send(mut self) -> Result<Neighbors, Error> {
        let states = std::mem::replace(&mut self.states, Ok(States::new(0)))?;
        let max_rows = |limits: &Limits| {
            let rows = limits::rows_of_answer(self.index.client(), limits, self.row_bytes());
            Ok(rows.min(limits.max_rows_per_call).min(READ_ROWS))
        };
        limits::read(
            &self.index,
            states.len(),
            max_rows,
            |part| self.message(&states, part),
            |answer, part| {
                let (call, include) = (v1::KnnRequest::NAME, self.options.include);
                let found = (answer.neighbors, answer.revision);
                neighbors(call, &self.index, found, part.len(), include)
            },
            Neighbors::append,
        )
        .await
    }

    /// The bytes of the most neighbours of one state.
    fn row_bytes(&self) -> usize {
        const COUNT_BYTES: usize = 5;
        let include = self.options.include;
        let neighbor = include.neighbor_bytes(self.index.coordinates());
        let k = self.bounds.max_neighbors().unwrap_or(usize::MAX);
        neighbor.saturating_mul(k).saturating_add(COUNT_BYTES)
    }

    pub(super) fn message(&self, states: &States, part: Range<usize>) -> v1::KnnRequest {
        v1::KnnRequest {
            index_name: self.index.name().to_owned(),
            states: Some(states.to_message(part)),
            k_form: self.bounds.k.map(|k| neighbor_spec::KForm::from(k).into()),
            radius_form: self
                .bounds
                .radius
                .map(|radius| neighbor_spec::RadiusForm::from(radius).into()),
            epsilon: self.options.epsilon,
            filter: self.options.filter.to_message(),
            include: self.options.include.to_message(),
            min_revision: self.index.min_revision(),
            latest: self.index.reads_latest(),
        }
    }
}

/// The answer to a request of `rows` states.
pub(super) fn neighbors(
    call: &'static str,
    index: &IndexHandle,
    (neighbors, revision): (Option<v1::Neighbors>, Option<v1::Revision>),
    rows: usize,
    include: Include,
) -> Result<Neighbors, Error> {
    let revision = index.answered(call, revision)?;
    let size = (rows, index.coordinates());
    Neighbors::from_message(call, neighbors, revision, size, include)
}
