//! What a worker has done, and where its time went.

use std::time::Duration;

use serde::{Deserialize, Serialize};

use crate::planning::processes::{self, Times};

/// What one worker, or several together, have done.
#[derive(Clone, Copy, Debug, Default, Serialize, Deserialize)]
pub struct Account {
    /// The states that were drawn.
    pub samples: u64,
    /// The milestones that are complete.
    pub milestones: u64,
    /// Their edges.
    pub edges: u64,
    /// The neighbours that arrived between a search and its insert.
    pub meanwhile: u64,
    /// The states that were checked for collisions.
    pub checks: u64,
    /// The time from the first sample to the last milestone.
    pub total: Duration,
    /// The time in searches for neighbours.
    pub searching: Duration,
    /// The time in drawing and in checks for collisions.
    pub checking: Duration,
    /// The time in inserts and updates.
    pub waiting: Duration,
}

impl processes::Account for Account {
    fn made(&self) -> u64 {
        self.milestones
    }

    fn times(&self) -> Times {
        Times {
            total: self.total,
            searching: self.searching,
            checking: self.checking,
            waiting: self.waiting,
        }
    }
}

impl std::iter::Sum for Account {
    fn sum<I: Iterator<Item = Account>>(accounts: I) -> Account {
        accounts.fold(Account::default(), |sum, one| Account {
            samples: sum.samples + one.samples,
            milestones: sum.milestones + one.milestones,
            edges: sum.edges + one.edges,
            meanwhile: sum.meanwhile + one.meanwhile,
            checks: sum.checks + one.checks,
            total: sum.total + one.total,
            searching: sum.searching + one.searching,
            checking: sum.checking + one.checking,
            waiting: sum.waiting + one.waiting,
        })
    }
}
