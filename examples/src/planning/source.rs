//! The source of neighbours.

use std::time::{Duration, Instant};

use wayfold::{Neighbor, States};
use wayfold_index::Search;

use super::error::PlanningError;

/// A growing set of states with nearest-neighbour search: the only interface of a planner to its storage.
///
/// States are canonical rows of one space. A call finds all states that earlier calls inserted.
pub trait NeighborSource {
    /// Stores states and returns their ids, ascending.
    fn insert(&mut self, states: &States) -> Result<Vec<u64>, PlanningError>;

    /// The neighbours that match `search`, in the order (distance, id).
    fn search(
        &mut self,
        state: &[f64],
        search: &Search<'_>,
    ) -> Result<Vec<Neighbor>, PlanningError>;

    /// The nearest state; None if the source is empty.
    fn nearest(&mut self, state: &[f64]) -> Result<Option<Neighbor>, PlanningError> {
        let found = self.search(state, &Search::nearest_k(1))?;
        Ok(found.first().copied())
    }
}

/// The usage of a source: its calls and their times.
#[derive(Clone, Copy, Debug, Default)]
pub struct Usage {
    /// The number of calls that inserted states.
    pub inserts: usize,
    /// The time they took.
    pub inserting: Duration,
    /// The number of searches.
    pub searches: usize,
    /// The time they took.
    pub searching: Duration,
}

impl Usage {
    /// The time spent in the source.
    pub fn time(&self) -> Duration {
        self.inserting + self.searching
    }
}

impl std::ops::Add for Usage {
    type Output = Usage;

    fn add(self, other: Usage) -> Usage {
        Usage {
            inserts: self.inserts + other.inserts,
            inserting: self.inserting + other.inserting,
            searches: self.searches + other.searches,
            searching: self.searching + other.searching,
        }
    }
}

/// A source with a record of its usage, so that sources need not measure themselves.
pub struct TimedSource {
    source: Box<dyn NeighborSource>,
    usage: Usage,
}

impl TimedSource {
    /// Measures `source` from now on.
    pub fn new(source: Box<dyn NeighborSource>) -> TimedSource {
        TimedSource {
            source,
            usage: Usage::default(),
        }
    }

    /// Its usage so far.
    pub fn usage(&self) -> Usage {
        self.usage
    }
}

impl NeighborSource for TimedSource {
    fn insert(&mut self, states: &States) -> Result<Vec<u64>, PlanningError> {
        let start = Instant::now();
        let ids = self.source.insert(states);
        self.usage.inserting += start.elapsed();
        self.usage.inserts += 1;
        ids
    }

    fn search(
        &mut self,
        state: &[f64],
        search: &Search<'_>,
    ) -> Result<Vec<Neighbor>, PlanningError> {
        let start = Instant::now();
        let found = self.source.search(state, search);
        self.usage.searching += start.elapsed();
        self.usage.searches += 1;
        found
    }
}
