//! What a worker has done, and where its time went.

use std::iter::Sum;

use serde::{Deserialize, Serialize};

use super::super::processes::{self, Times};

/// What one worker, or several together, have done.
#[derive(Clone, Copy, Debug, Default, Serialize, Deserialize)]
pub struct Account {
    /// The states that were drawn.
    pub samples: u64,
    /// The vertices that were inserted.
    pub vertices: u64,
    /// The calls that inserted them.
    pub inserts: u64,
    /// The states that were checked for collisions.
    pub checks: usize,
    /// Where its time went, from the first sample to the end.
    pub times: Times,
}

impl processes::Account for Account {
    fn made(&self) -> u64 {
        self.vertices
    }

    fn times(&self) -> Times {
        self.times
    }
}

impl Sum for Account {
    fn sum<I: Iterator<Item = Account>>(accounts: I) -> Account {
        accounts.fold(Account::default(), |sum, one| Account {
            samples: sum.samples + one.samples,
            vertices: sum.vertices + one.vertices,
            inserts: sum.inserts + one.inserts,
            checks: sum.checks + one.checks,
            times: sum.times + one.times,
        })
    }
}
