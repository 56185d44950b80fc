//! What a worker has done, and where its time went.

use std::{iter::Sum, time::Duration};

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
    /// The time from the first sample to the end.
    pub total: Duration,
    /// The time in searches for neighbours.
    pub searching: Duration,
    /// The time in drawing and in checks for collisions.
    pub checking: Duration,
    /// The time in which an insert was waited for.
    pub waiting: Duration,
}

impl processes::Account for Account {
    fn made(&self) -> u64 {
        self.vertices
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

impl Sum for Account {
    fn sum<I: Iterator<Item = Account>>(accounts: I) -> Account {
        accounts.fold(Account::default(), |sum, one| Account {
            samples: sum.samples + one.samples,
            vertices: sum.vertices + one.vertices,
            inserts: sum.inserts + one.inserts,
            checks: sum.checks + one.checks,
            total: sum.total + one.total,
            searching: sum.searching + one.searching,
            checking: sum.checking + one.checking,
            waiting: sum.waiting + one.waiting,
        })
    }
}
