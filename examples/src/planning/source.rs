//! Where the neighbours come from.

use std::time::{Duration, Instant};

use wayfold::{Neighbor, Search, States};

use super::error::PlanningError;

/// A growing set of states that tells which of them are near: all that a planner needs to know of its storage.
///
/// States are canonical rows of one space. What one call has inserted, the next one finds.
pub trait NeighborSource {
    /// Stores states and returns their ids, ascending.
    fn insert(&mut self, states: &States) -> Result<Vec<u64>, PlanningError>;

    /// The neighbours that `search` asks for, in the order (distance, id).
    fn search(
        &mut self,
        state: &[f64],
        search: &Search<'_>,
    ) -> Result<Vec<Neighbor>, PlanningError>;

    /// The nearest one, unless there is none.
    fn nearest(&mut self, state: &[f64]) -> Result<Option<Neighbor>, PlanningError> {
        let found = self.search(state, &Search::nearest_k(1))?;
        Ok(found.first().copied())
    }
}

/// What a source has been asked, and how long its answers took.
#[derive(Clone, Copy, Debug, Default)]
pub struct Usage {
    /// How many calls inserted states.
    pub inserts: usize,
    /// The time they took.
    pub inserting: Duration,
    /// How many searches there were.
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

/// A source, and what it has been used for: so that none of them measures itself.
pub struct Timed {
    source: Box<dyn NeighborSource>,
    usage: Usage,
}

impl Timed {
    /// Measures `source` from now on.
    pub fn new(source: Box<dyn NeighborSource>) -> Timed {
        Timed {
            source,
            usage: Usage::default(),
        }
    }

    /// What it has been used for.
    pub fn usage(&self) -> Usage {
        self.usage
    }
}

impl NeighborSource for Timed {
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
