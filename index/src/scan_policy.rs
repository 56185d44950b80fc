//! Scan or descend: the choice for the next search of a tree, by the leaves that earlier searches had to visit.
//!
//! In many dimensions all points are about equally far away. A search then visits most leaves, and reading all of them
//! in memory order, without their boxes, takes less time.
//!
//! Measured without scans, as a multiple of the time with them, in a tree of 50,000 points with codes and in a growing
//! tree of 8,000 points; data, method and machine as in [`quantize`](crate::quantize).
//!
//! | | R12 | SE3² | SE3⁴ | R30 |
//! |---|---|---|---|---|
//! | tree, k = 1 | 1.00 | 1.01 | 1.37 | 1.86 |
//! | tree, k = 10 | 1.03 | 1.03 | 1.50 | 1.77 |
//! | growing, k = 1 | 1.00 | 0.92 | 1.50 | 1.73 |
//! | growing, k = 10 | 1.00 | 0.98 | 1.54 | 1.70 |

use std::sync::atomic::{AtomicU32, AtomicUsize, Ordering::Relaxed};

/// The number of consecutive searches that a scan must have been cheaper for: a single query may lie far outside.
const MIN_CHEAPER_SCANS: u32 = 4;

/// The number of searches that then scan, before the next one descends.
const SCANS: u32 = 64;

/// The policy of one tree.
#[derive(Debug, Default)]
pub(crate) struct ScanPolicy {
    /// Up to `MIN_CHEAPER_SCANS`, the searches in a row that a scan was cheaper for; above it, `MIN_CHEAPER_SCANS` plus
    /// the scans to come. A race between threads may lose a step, which does no harm.
    state: AtomicU32,
    /// The number of scans so far, for tests.
    scans: AtomicUsize,
}

impl ScanPolicy {
    /// True if the next search scans.
    pub(crate) fn next_scans(&self) -> bool {
        let state = self.state.load(Relaxed);
        if state > MIN_CHEAPER_SCANS {
            self.state.store(state - 1, Relaxed);
            self.scans.fetch_add(1, Relaxed);
        }
        state > MIN_CHEAPER_SCANS
    }

    /// The number of scans so far.
    pub(crate) fn scans(&self) -> usize {
        self.scans.load(Relaxed)
    }

    /// Records a search that descended; `scan_is_cheaper` is true if a scan would have cost less.
    pub(crate) fn observe(&self, scan_is_cheaper: bool) {
        let state = self.state.load(Relaxed);
        if scan_is_cheaper {
            let next = if state + 1 < MIN_CHEAPER_SCANS {
                state + 1
            } else {
                MIN_CHEAPER_SCANS + SCANS
            };
            self.state.store(next, Relaxed);
        } else if state > 0 {
            self.state.store(0, Relaxed);
        }
    }
}

impl Clone for ScanPolicy {
    fn clone(&self) -> Self {
        Self::default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_tree_is_scanned_after_searches_visited_most_of_it_and_descended_again_later() {
        let policy = ScanPolicy::default();
        for _ in 1..MIN_CHEAPER_SCANS {
            policy.observe(true);
            assert!(!policy.next_scans());
        }
        for _ in 0..3 {
            policy.observe(true);
            for _ in 0..SCANS {
                assert!(policy.next_scans());
            }
            assert!(!policy.next_scans());
        }
        assert_eq!(policy.scans(), 3 * SCANS as usize);
        policy.observe(false);
        policy.observe(true);
        assert!(!policy.next_scans());
    }
}
