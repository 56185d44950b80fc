//! The search of an [`Index`](super::Index).

use std::time::{Duration, Instant};

use wayfold_index::{Filter, ReadRevision, ScaledSearch, Scaling};

use crate::{
    Error, Radius, ScaledRadius,
    search::{Bounds, K},
};

/// A search of an [`Index`](crate::Index): the number of neighbours, the radius, and the points that count.
///
/// ```
/// use wayfold::{ScaledRadius, Search};
///
/// // Of tree 1, whose number is in the lowest two bits of its points' tags.
/// let ten_near = Search::k(10).radius(0.5).tag(0b11, 1);
/// let of_rrt_star = Search::within(ScaledRadius::new(1.1).max(0.5));
/// ```
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Search {
    bounds: Bounds,
    tag_mask: u64,
    tag_value: u64,
    since: ReadRevision,
    epsilon: f64,
    timeout: Option<Duration>,
}

impl Search {
    fn of(k: Option<K>, radius: Option<Radius>) -> Search {
        Search {
            bounds: Bounds { k, radius },
            tag_mask: 0,
            tag_value: 0,
            since: ReadRevision::default(),
            epsilon: 0.0,
            timeout: None,
        }
    }

    /// The `k` nearest, at least 1.
    pub fn k(k: u32) -> Search {
        Search::of(Some(K::Fixed(k)), None)
    }

    /// The ⌈factor · ln n⌉ nearest, at least 1, among n points. PRM* takes [`Scaling::K_FACTOR`].
    pub fn k_factor(factor: f64) -> Search {
        Search::of(Some(K::Scaled(factor)), None)
    }

    /// All at distance `radius` or nearer: a number, or a [`ScaledRadius`].
    pub fn within(radius: impl Into<Radius>) -> Search {
        Search::of(None, Some(radius.into()))
    }

    /// Only those at distance `radius` or nearer.
    pub fn radius(mut self, radius: impl Into<Radius>) -> Search {
        self.bounds.radius = Some(radius.into());
        self
    }

    /// Only points with `tag & mask == value`.
    pub fn tag(mut self, mask: u64, value: u64) -> Search {
        (self.tag_mask, self.tag_value) = (mask, value);
        self
    }

    /// Only points that an earlier answer, which read this revision, could not find. A point that got its tag since
    /// does not count.
    /// All points count if a shared index has read its copy again since: [`Index::changes`](crate::Index::changes) is
    /// `None` for that revision then.
    pub fn since(mut self, revision: ReadRevision) -> Search {
        self.since = revision;
        self
    }

    /// Answers may be farther than the true ones by a factor of 1 + epsilon, and points beyond radius / (1 + epsilon)
    /// may be missing; 0, exact, unless set.
    pub fn epsilon(mut self, epsilon: f64) -> Search {
        self.epsilon = epsilon;
        self
    }

    /// Fails with [`Error::SearchTimeout`] if the search takes longer; without a limit unless set. A search of many
    /// states has this time for all of them together.
    pub fn timeout(mut self, timeout: Duration) -> Search {
        self.timeout = Some(timeout);
        self
    }

    /// The search in the terms of the index.
    pub(crate) fn scaled(&self) -> Result<ScaledSearch<'static>, Error> {
        let mut search = wayfold_index::Search::nearest_k(match self.bounds.k {
            Some(K::Fixed(0)) => return Err(argument("k", "0; it is at least 1")),
            Some(K::Fixed(k)) => k as usize,
            Some(K::Scaled(factor)) => {
                check_finite("k_factor", factor)?;
                usize::MAX
            }
            None => usize::MAX,
        });
        match self.bounds.radius {
            Some(Radius::Fixed(radius)) => {
                check_distance("radius", radius)?;
                search.radius = radius;
            }
            Some(Radius::Scaled(ScaledRadius { factor, max })) => {
                check_finite("scaled_radius.factor", factor)?;
                check_distance("scaled_radius.max", max.unwrap_or(f64::INFINITY))?;
            }
            None => {}
        }
        check_finite("epsilon", self.epsilon)?;
        if self.tag_value & !self.tag_mask != 0 {
            let (mask, value) = (self.tag_mask, self.tag_value);
            let problem =
                format!("{value:#x} has bits outside the mask {mask:#x}: no tag could match");
            return Err(argument("tag", problem));
        }
        search.epsilon = self.epsilon;
        let until = |timeout| Instant::now().checked_add(timeout);
        search.until = self.timeout.and_then(until);
        search.filter = Filter {
            tag_mask: self.tag_mask,
            tag_value: self.tag_value,
            since_revision: self.since.0,
        };
        Ok(ScaledSearch {
            search,
            scaling: self.bounds.scaling(),
        })
    }
}

/// The search for the nearest `k`, without any factor.
pub(super) fn nearest_k(k: usize) -> ScaledSearch<'static> {
    ScaledSearch {
        search: wayfold_index::Search::nearest_k(k),
        scaling: Scaling::default(),
    }
}

fn check_distance(field: &'static str, number: f64) -> Result<(), Error> {
    match number {
        number if number.is_nan() => Err(argument(field, "NaN")),
        number if number < 0.0 => Err(argument(field, format!("{number}; it is at least 0"))),
        _ => Ok(()),
    }
}

fn check_finite(field: &'static str, number: f64) -> Result<(), Error> {
    match number {
        f64::INFINITY => Err(argument(field, "infinite; it is a finite number")),
        number => check_distance(field, number),
    }
}

fn argument(field: &'static str, problem: impl Into<String>) -> Error {
    Error::Argument {
        field,
        problem: problem.into(),
    }
}
