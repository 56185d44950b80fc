//! Whether a tree is worth descending, by what the searches themselves report.
//!
//! In many dimensions all points are about equally far away: then a search reaches most leaves, and reading all in the
//! order of memory, without a look at boxes, takes less time.

use std::sync::atomic::{AtomicU32, AtomicUsize, Ordering::Relaxed};

/// So many searches in a row must have reached that many leaves that reading all takes less time: a single one may come from
/// far away.
const TRIES: u32 = 4;

/// For so many searches the leaves are then read one after the other, before one descends again.
const SCANS: u32 = 64;

/// Up to `TRIES` counts searches that reached most of the tree; what it is above counts scans to come. Searches of
/// other threads may come between a look and a change, which does no harm.
#[derive(Debug, Default)]
pub(crate) struct Reach {
    state: AtomicU32,
    /// The number of scans so far, which tests ask for.
    scans: AtomicUsize,
}

impl Reach {
    /// Whether the next search is to read all leaves.
    pub(crate) fn is_far(&self) -> bool {
        let state = self.state.load(Relaxed);
        if state > TRIES {
            self.state.store(state - 1, Relaxed);
            self.scans.fetch_add(1, Relaxed);
        }
        state > TRIES
    }

    /// The number of searches that read all leaves.
    pub(crate) fn scans(&self) -> usize {
        self.scans.load(Relaxed)
    }

    /// Tells whether a search that descended has reached so `many` leaves that reading all would have taken less time.
    pub(crate) fn report(&self, many: bool) {
        let state = self.state.load(Relaxed);
        if many {
            let next = if state + 1 < TRIES {
                state + 1
            } else {
                TRIES + SCANS
            };
            self.state.store(next, Relaxed);
        } else if state > 0 {
            self.state.store(0, Relaxed);
        }
    }
}

impl Clone for Reach {
    fn clone(&self) -> Self {
        Self::default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_tree_is_scanned_once_searches_reached_most_of_it_and_tried_again_later() {
        let reach = Reach::default();
        for _ in 1..TRIES {
            reach.report(true);
            assert!(!reach.is_far());
        }
        for _ in 0..3 {
            reach.report(true);
            for _ in 0..SCANS {
                assert!(reach.is_far());
            }
            assert!(!reach.is_far());
        }
        reach.report(false);
        reach.report(true);
        assert!(!reach.is_far());
    }
}
