//! Where a planner's time went, and how it came to that.

use std::time::Duration;

use super::source::Usage;

/// Where a run's time went.
#[derive(Clone, Copy, Debug)]
pub struct Account {
    /// All of it.
    pub total: Duration,
    /// What went into the sources.
    pub neighbors: Usage,
    /// What went into motions: their states and whether these are free.
    pub checking: Duration,
    /// How many states were checked.
    pub checks: usize,
}

impl Account {
    /// What is left: the planner's own.
    pub fn rest(&self) -> Duration {
        self.total
            .saturating_sub(self.neighbors.time() + self.checking)
    }
}

/// How far a run was at some moment.
#[derive(Clone, Copy, Debug)]
pub struct Growth {
    /// The nodes of all trees, or the milestones.
    pub nodes: usize,
    /// The account until then.
    pub account: Account,
}

/// How many moments of a long run are kept, at least; of twice as many every other one is dropped.
const RECORDS: usize = 256;

/// The moments of a run that are remembered.
#[derive(Debug)]
pub struct Record {
    growth: Vec<Growth>,
    every: usize,
}

impl Record {
    /// None yet.
    pub fn new() -> Record {
        Record {
            growth: Vec::new(),
            every: 1,
        }
    }

    /// Whether the last one is long ago.
    pub fn is_due(&self, nodes: usize) -> bool {
        let last = self.growth.last().map_or(0, |growth| growth.nodes);
        nodes >= last + self.every
    }

    /// Remembers this moment.
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

    /// All of them, and the last one.
    pub fn finish(mut self, nodes: usize, account: Account) -> Vec<Growth> {
        self.growth.push(Growth { nodes, account });
        self.growth
    }
}
