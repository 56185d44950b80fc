//! The states of a planner: an index in one of its three forms, or one of the two scans that indices are compared with.

use std::time::{Duration, Instant};

use wayfold::{Index, Neighbor, Space, States};
use wayfold_index::{Forest, ForestOptions, Points, Search};

use super::{
    error::PlanningError,
    host::{Host, Temporary},
    options::Source,
};

/// A growing set of states with nearest-neighbour search, and the account of its use.
///
/// States are canonical rows of one space. A call finds all states that earlier calls inserted.
pub struct TimedIndex {
    form: Form,
    usage: Usage,
    /// Deletes the index from the server, after `form` is dropped.
    _temporary: Option<Temporary>,
}

enum Form {
    Index(Index),
    /// A forest without trees: leaves with thousands of points are scanned completely, many points at once by SIMD.
    Scan(Forest),
    /// The paper's baseline: every search computes the distance of every state, one after the other.
    Brute(Space, States),
}

impl TimedIndex {
    /// An empty one. The forms `shared` and `remote` need a server.
    pub fn new(
        source: Source,
        space: &Space,
        host: Option<&Host>,
    ) -> Result<TimedIndex, PlanningError> {
        let mut temporary = None;
        let form = match source {
            Source::Brute => Form::Brute(space.clone(), States::new(space.coordinates())),
            Source::Scan => {
                let options = ForestOptions {
                    growing_rows: 4096,
                    leaf_rows: 4096,
                };
                Form::Scan(Forest::new(space.clone(), options))
            }
            Source::Memory | Source::All => Form::Index(Index::in_memory(space)?),
            Source::Shared | Source::Remote => {
                let own = temporary.insert(host.ok_or(PlanningError::NoServer)?.temporary());
                Form::Index(own.create(source, space)?)
            }
        };
        Ok(TimedIndex {
            form,
            usage: Usage::default(),
            _temporary: temporary,
        })
    }

    /// Stores states and returns their ids, ascending.
    pub fn insert(&mut self, states: &States) -> Result<Vec<u64>, PlanningError> {
        let start = Instant::now();
        let ids = self.form.insert(states);
        self.usage.inserting += start.elapsed();
        self.usage.inserts += 1;
        ids
    }

    /// The `k` nearest states, in the order (distance, id).
    pub fn nearest_k(&mut self, state: &[f64], k: usize) -> Result<Vec<Neighbor>, PlanningError> {
        let start = Instant::now();
        let found = self.form.nearest_k(state, k);
        self.usage.searching += start.elapsed();
        self.usage.searches += 1;
        found
    }

    /// The nearest state; None if there are none.
    pub fn nearest(&mut self, state: &[f64]) -> Result<Option<Neighbor>, PlanningError> {
        Ok(self.nearest_k(state, 1)?.first().copied())
    }

    /// Waits until the server of a shared index has acknowledged every insert; returns the time it took.
    pub fn flush(&self) -> Result<Duration, PlanningError> {
        let start = Instant::now();
        if let Form::Index(index) = &self.form {
            index.flush()?;
        }
        Ok(start.elapsed())
    }

    /// Its use so far.
    pub fn usage(&self) -> Usage {
        self.usage
    }
}

impl Form {
    fn insert(&mut self, states: &States) -> Result<Vec<u64>, PlanningError> {
        let first = match self {
            Form::Index(index) => return Ok(index.insert_many(states)?),
            Form::Scan(forest) => {
                let (first, revision) = (forest.len(), forest.revision() + 1);
                let mut points = Points::with_capacity(states.width(), states.len());
                for (id, state) in (first as u64..).zip(states) {
                    points.push(id, 0, revision, state);
                }
                forest
                    .apply(revision, &points, &[])
                    .expect("canonical states");
                first
            }
            Form::Brute(_, stored) => {
                let first = stored.len();
                for state in states {
                    stored.push(state)?;
                }
                first
            }
        };
        Ok((first as u64..(first + states.len()) as u64).collect())
    }

    fn nearest_k(&self, state: &[f64], k: usize) -> Result<Vec<Neighbor>, PlanningError> {
        Ok(match self {
            Form::Index(index) => index.nearest_k(state, u32::try_from(k).unwrap_or(u32::MAX))?,
            Form::Scan(forest) => {
                let answer = forest.search(state, &Search::nearest_k(k));
                answer.expect("canonical states").neighbors
            }
            Form::Brute(space, stored) => brute_force(space, stored, state, k),
        })
    }
}

fn brute_force(space: &Space, stored: &States, state: &[f64], k: usize) -> Vec<Neighbor> {
    let measured = (0..).zip(stored).map(|(id, stored)| Neighbor {
        distance: space.distance(state, stored),
        id,
    });
    if k == 1 {
        return measured.min().into_iter().collect();
    }
    let mut found: Vec<Neighbor> = measured.collect();
    if k < found.len() {
        // The others are not sorted: sorting would take longer than computing their distances.
        found.select_nth_unstable(k);
        found.truncate(k);
    }
    found.sort_unstable();
    found
}

/// The calls of a planner and their times.
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
    /// The time of all calls.
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
