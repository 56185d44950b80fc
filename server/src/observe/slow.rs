//! The line of a slow call, which says where its time went.

use std::{sync::Arc, time::Duration};

use tracing::{Span, warn};

use super::sparse::SparseLines;

/// The calls that take longer than a threshold. Clones share the count of those without a line.
#[derive(Clone, Debug)]
pub(crate) struct SlowCalls {
    /// None: no call is slow.
    threshold: Option<Duration>,
    /// A server on which all calls are slow writes one line for many.
    lines: Arc<SparseLines>,
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
    pub(super) fn report(&self, span: &Span, whole: Duration, times: &Times) {
        if self.threshold.is_none_or(|threshold| whole < threshold) {
            return;
        }
        let Some(left_out) = self.lines.next() else {
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

fn ms(time: Duration) -> u64 {
    u64::try_from(time.as_millis()).unwrap_or(u64::MAX)
}
