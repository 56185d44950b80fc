//! What a worker has done, and where its time went.

use std::iter::Sum;

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
    /// Where its time went, from the first sample to the end.
    pub times: Times,
}

impl processes::Account for Account {
    fn made(&self) -> u64 {
        self.milestones
    }

    fn times(&self) -> Times {
        self.times
    }
}

impl Sum for Account {
    fn sum<I: Iterator<Item = Account>>(accounts: I) -> Account {
        accounts.fold(Account::default(), |sum, one| Account {
            samples: sum.samples + one.samples,
            milestones: sum.milestones + one.milestones,
            edges: sum.edges + one.edges,
            meanwhile: sum.meanwhile + one.meanwhile,
            checks: sum.checks + one.checks,
            times: sum.times + one.times,
        })
    }
}
