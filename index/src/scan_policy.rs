//! Scan or descend: the choice for the next search of a tree, by the leaves that earlier searches had to visit.
//!
//! In many dimensions all points are about equally far away. A search then visits most leaves, and reading all of them
//! in memory order, without their boxes, takes less time.
//!
//! Measured without scans, as a multiple of the time with them, in a tree of 50,000 points with codes and in a growing
//! tree of 8,000 points, when four descents led to 64 scans at once; data, method and machine as in
//! [`quantize`](crate::quantize).
//!
//! | | R12 | SE3² | SE3⁴ | R30 |
//! |---|---|---|---|---|
//! | tree, k = 1 | 1.00 | 1.01 | 1.37 | 1.86 |
//! | tree, k = 10 | 1.03 | 1.03 | 1.50 | 1.77 |
//! | growing, k = 1 | 1.00 | 0.92 | 1.50 | 1.73 |
//! | growing, k = 10 | 1.00 | 0.98 | 1.54 | 1.70 |

use std::sync::atomic::{AtomicU32, AtomicUsize, Ordering::Relaxed};

/// The number of consecutive searches that a scan must have been cheaper for: a single query may lie far outside. As
/// many searches then scan, before the next one descends. If a scan would have been cheaper again, twice as many scan.
const MIN_CHEAPER_SCANS: u32 = 4;

/// The greatest number of scans between two descents.
const MAX_SCANS: u32 = 64;

/// The policy of one tree. A race between threads may lose or repeat a few scans.
#[derive(Debug, Default)]
pub(crate) struct ScanPolicy {
    /// Below `MIN_CHEAPER_SCANS`, the searches in a row that a scan was cheaper for; from there on, the scans that the
    /// last descent led to.
    run: AtomicU32,
    /// The scans to come.
    remaining: AtomicU32,
    /// The number of scans so far, for tests.
    scans: AtomicUsize,
}

impl ScanPolicy {
    /// True if the next search scans.
    pub(crate) fn next_scans(&self) -> bool {
        let remaining = self.remaining.load(Relaxed);
        if remaining > 0 {
            self.remaining.store(remaining - 1, Relaxed);
            self.scans.fetch_add(1, Relaxed);
        }
        remaining > 0
    }

    /// The number of scans so far.
    pub(crate) fn scans(&self) -> usize {
        self.scans.load(Relaxed)
    }

    /// Records a search that descended; `scan_is_cheaper` is true if a scan would have cost less.
    pub(crate) fn observe(&self, scan_is_cheaper: bool) {
        // The descent began before these scans were due.
        if self.remaining.load(Relaxed) > 0 {
            return;
        }
        let run = self.run.load(Relaxed);
        let next = match scan_is_cheaper {
            true if run < MIN_CHEAPER_SCANS => run + 1,
            true => MAX_SCANS.min(2 * run),
            // Threads share the policy of a tree that none of them scans, so it is only read.
            false if run == 0 => return,
            false => 0,
        };
        self.run.store(next, Relaxed);
        let scans = if next < MIN_CHEAPER_SCANS { 0 } else { next };
        self.remaining.store(scans, Relaxed);
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
    fn descents_under_way_when_scans_become_due_change_nothing() {
        let policy = ScanPolicy::default();
        (0..8).for_each(|_| policy.observe(true));
        policy.observe(false);
        let scans = std::iter::repeat_with(|| policy.next_scans());
        assert_eq!(scans.take_while(|&scans| scans).count(), 4);
    }

    #[test]
    fn each_descent_that_confirms_the_scans_before_it_doubles_those_after_it() {
        let policy = ScanPolicy::default();
        let scans_after = |scan_is_cheaper| {
            policy.observe(scan_is_cheaper);
            std::iter::repeat_with(|| policy.next_scans())
                .take_while(|&scans| scans)
                .count()
        };
        for _ in 0..2 {
            let scans = [(); 10].map(|()| scans_after(true));
            assert_eq!(scans, [0, 0, 0, 4, 8, 16, 32, 64, 64, 64]);
            assert_eq!(scans_after(false), 0);
        }
        assert_eq!(policy.scans(), 2 * 252);
        let interrupted = [true, true, true, false, true].map(scans_after);
        assert_eq!(interrupted, [0; 5]);
    }
}
