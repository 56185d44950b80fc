//! Log lines that a flood of calls could cause: at most one a second is written.

use std::time::{Duration, Instant};

use parking_lot::Mutex;

/// The least time between two lines.
const INTERVAL: Duration = Duration::from_secs(1);

/// The lines of one kind: at most one a second. Each tells how many were left out before it.
#[derive(Debug, Default)]
pub(crate) struct SparseLines(Mutex<State>);

#[derive(Debug, Default)]
struct State {
    last: Option<Instant>,
    left_out: u64,
}

impl SparseLines {
    pub(crate) const fn new() -> Self {
        Self(Mutex::new(State {
            last: None,
            left_out: 0,
        }))
    }

    /// The number of lines that were left out before this one; None if this one is left out too.
    pub(crate) fn next(&self) -> Option<u64> {
        self.0.lock().next(Instant::now())
    }
}

impl State {
    fn next(&mut self, now: Instant) -> Option<u64> {
        if self.last.is_some_and(|last| now < last + INTERVAL) {
            self.left_out += 1;
            return None;
        }
        self.last = Some(now);
        Some(std::mem::take(&mut self.left_out))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_counts_those_that_were_left_out() {
        let (mut lines, start) = (State::default(), Instant::now());
        let at = |ms| start + Duration::from_millis(ms);
        let written = [0, 1, 999, 1000, 2500].map(|ms| lines.next(at(ms)));
        assert_eq!(written, [Some(0), None, None, Some(2), Some(0)]);
    }
}
