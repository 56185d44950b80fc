//! The account of a planner's time, and its history.

use std::time::Duration;

use super::source::Usage;

/// The account of a run's time.
#[derive(Clone, Copy, Debug)]
pub struct Account {
    /// The total time.
    pub total: Duration,
    /// The time of searches and inserts.
    pub neighbors: Usage,
    /// The time of motions: computing their states and checking these for collisions.
    pub checking: Duration,
    /// The number of checked states.
    pub checks: usize,
    /// The time from the end of the run until the server had acknowledged every insert.
    pub flushing: Duration,
}

impl Account {
    /// The remaining time, which is the planner's own.
    pub fn rest(&self) -> Duration {
        self.total
            .saturating_sub(self.neighbors.time() + self.checking)
    }
}

/// The progress of a run at one moment.
#[derive(Clone, Copy, Debug)]
pub struct Growth {
    /// The nodes of all trees, or the milestones.
    pub nodes: usize,
    /// The account up to that moment.
    pub account: Account,
}

/// The minimum number of kept moments of a long run. At twice this number, every other one is dropped.
const RECORDS: usize = 256;

/// The remembered moments of a run.
#[derive(Debug)]
pub struct Record {
    growth: Vec<Growth>,
    every: usize,
}

impl Record {
    /// An empty history.
    pub fn new() -> Record {
        Record {
            growth: Vec::new(),
            every: 1,
        }
    }

    /// True if the next moment is due.
    pub fn is_due(&self, nodes: usize) -> bool {
        let last = self.growth.last().map_or(0, |growth| growth.nodes);
        nodes >= last + self.every
    }

    /// Adds this moment.
    pub fn note(&mut self, nodes: usize, account: Account) {
        self.growth.push(Growth { nodes, account });
        if self.growth.len() >= 2 * RECORDS {
            let mut kept = 0;
            self.growth.retain(|_| {
                kept += 1;
                kept % 2 == 0
            });
            self.every = (nodes / RECORDS).max(1);
        }
    }

    /// All moments, ending with the last one.
    pub fn finish(mut self, nodes: usize, account: Account) -> Vec<Growth> {
        self.growth.push(Growth { nodes, account });
        self.growth
    }
}
