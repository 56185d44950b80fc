//! The account of a worker.

use std::iter::Sum;

use serde::{Deserialize, Serialize};

use crate::planning::processes::{self, Times};

/// The account of one worker, or of several together.
#[derive(Clone, Copy, Debug, Default, Serialize, Deserialize)]
pub struct Account {
    /// The number of drawn states.
    pub samples: u64,
    /// The number of complete milestones.
    pub milestones: u64,
    /// The number of their edges.
    pub edges: u64,
    /// The number of neighbours that the search before the insert did not find.
    pub meanwhile: u64,
    /// The number of states that were checked for collisions.
    pub checks: u64,
    /// The account of its time from the first sample to the end.
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
