//! Sources in this process, for a planner without a service.

use wayfold::{Neighbor, Space, States};
use wayfold_index::{Forest, ForestOptions, Points, Search};

use super::{error::PlanningError, source::NeighborSource};

/// The paper's baseline: every search computes the distance of every state, one after the other.
pub struct BruteForce {
    space: Space,
    states: States,
}

impl BruteForce {
    /// An empty source.
    pub fn new(space: &Space) -> BruteForce {
        BruteForce {
            space: space.clone(),
            states: States::new(space.coordinates()),
        }
    }
}

impl NeighborSource for BruteForce {
    fn insert(&mut self, states: &States) -> Result<Vec<u64>, PlanningError> {
        let first = self.states.len() as u64;
        for state in states {
            self.states.push(state)?;
        }
        Ok((first..self.states.len() as u64).collect())
    }

    fn search(
        &mut self,
        state: &[f64],
        search: &Search<'_>,
    ) -> Result<Vec<Neighbor>, PlanningError> {
        let measured = (0..).zip(&self.states).map(|(id, stored)| Neighbor {
            distance: self.space.distance(state, stored),
            id,
        });
        let within = measured.filter(|neighbor| neighbor.distance <= search.radius);
        if search.k == 1 {
            return Ok(within.min().into_iter().collect());
        }
        let mut found: Vec<Neighbor> = within.collect();
        if search.k < found.len() {
            // The others are not sorted: sorting would take longer than computing their distances.
            found.select_nth_unstable(search.k);
            found.truncate(search.k);
        }
        found.sort_unstable();
        Ok(found)
    }
}

/// The server's index, in this process and on this thread only.
pub struct LocalForest {
    forest: Forest,
    merges: bool,
}

impl LocalForest {
    /// The kd-trees. Merges run on this thread, within the inserts that make them due, so their time counts there.
    pub fn trees(space: &Space) -> LocalForest {
        LocalForest {
            forest: Forest::new(space.clone(), ForestOptions::for_space(space)),
            merges: true,
        }
    }

    /// A forest without trees: leaves with thousands of points are scanned completely, many points at once by SIMD.
    pub fn scan(space: &Space) -> LocalForest {
        let options = ForestOptions {
            growing_rows: 4096,
            leaf_rows: 4096,
        };
        LocalForest {
            forest: Forest::new(space.clone(), options),
            merges: false,
        }
    }
}

impl NeighborSource for LocalForest {
    fn insert(&mut self, states: &States) -> Result<Vec<u64>, PlanningError> {
        let first = self.forest.len() as u64;
        let ids: Vec<u64> = (first..first + states.len() as u64).collect();
        let revision = self.forest.revision() + 1;
        let mut points = Points::with_capacity(states.width(), states.len());
        for (&id, state) in ids.iter().zip(states) {
            points.push(id, 0, revision, state);
        }
        self.forest
            .apply(revision, &points, &[])
            .expect("canonical states");
        if self.merges {
            self.forest.settle();
        }
        Ok(ids)
    }

    fn search(
        &mut self,
        state: &[f64],
        search: &Search<'_>,
    ) -> Result<Vec<Neighbor>, PlanningError> {
        Ok(self
            .forest
            .search(state, search)
            .expect("canonical states")
            .neighbors)
    }
}
