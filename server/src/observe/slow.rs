//! The line of a slow call, which says where its time went.

use std::{
    sync::Arc,
    time::{Duration, Instant},
};

use parking_lot::Mutex;
use tracing::{Span, field, warn};

use crate::service::Peer;

/// The least time between two lines: a server on which all calls are slow writes one for many.
const INTERVAL: Duration = Duration::from_secs(1);

/// The calls that take longer than a threshold. Clones share the count of those without a line.
#[derive(Clone, Debug)]
pub(crate) struct SlowCalls {
    /// None: no call is slow.
    threshold: Option<Duration>,
    lines: Arc<Mutex<Lines>>,
}

#[derive(Debug, Default)]
struct Lines {
    last: Option<Instant>,
    /// The slow calls since then.
    left_out: u64,
}

/// The parts of the time of a call with one answer.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Times {
    /// The time until the request had arrived.
    pub(crate) received: Duration,
    /// The wait for turns to compute.
    pub(crate) queued: Duration,
    pub(crate) computed: Duration,
    /// The time until the answer was made. It contains `queued`, `computed`, and the waits for the log, the disk or a
    /// revision.
    pub(crate) answered: Duration,
}

impl SlowCalls {
    /// The calls that take at least `threshold_ms`; none if it is 0.
    pub(crate) fn new(threshold_ms: u64) -> Self {
        Self {
            threshold: (threshold_ms > 0).then(|| Duration::from_millis(threshold_ms)),
            lines: Arc::default(),
        }
    }

    /// Writes a line if a call that took `whole` was slow.
    pub(super) fn report(&self, span: &Span, peer: Option<Peer>, whole: Duration, times: &Times) {
        if self.threshold.is_none_or(|threshold| whole < threshold) {
            return;
        }
        let Some(left_out) = self.lines.lock().next(Instant::now()) else {
            return;
        };
        let Times {
            received,
            queued,
            computed,
            answered,
        } = *times;
        let waited = answered.saturating_sub(received + queued + computed);
        warn!(
            parent: span,
            peer = peer.map(field::display),
            total_ms = ms(whole),
            receiving_ms = ms(received),
            queued_ms = ms(queued),
            computing_ms = ms(computed),
            waiting_ms = ms(waited),
            sending_ms = ms(whole.saturating_sub(answered)),
            left_out,
            "slow call"
        );
    }
}

impl Lines {
    /// The number of slow calls without a line before this one; None if this one gets none either.
    fn next(&mut self, now: Instant) -> Option<u64> {
        if self.last.is_some_and(|last| now < last + INTERVAL) {
            self.left_out += 1;
            return None;
        }
        self.last = Some(now);
        Some(std::mem::take(&mut self.left_out))
    }
}

fn ms(time: Duration) -> u64 {
    u64::try_from(time.as_millis()).unwrap_or(u64::MAX)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_counts_the_slow_calls_that_had_none() {
        let (mut lines, start) = (Lines::default(), Instant::now());
        let at = |ms| start + Duration::from_millis(ms);
        let written = [0, 1, 999, 1000, 2500].map(|ms| lines.next(at(ms)));
        assert_eq!(written, [Some(0), None, None, Some(2), Some(0)]);
    }
}
