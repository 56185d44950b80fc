//! The trend of the queue. It stands if its calls are late and it does not get shorter.
//!
//! The wait alone cannot tell. Of 64 calls that come at once, most are late, and all can be answered in a second. But
//! nothing comes behind them, so their queue gets shorter from the first call on.

use std::time::{Duration, Instant};

/// The least length of a window. It ends with the first call that begins after that.
const WINDOW: Duration = Duration::from_millis(50);

/// The queue stands after this many windows one after the other in which it stood.
const WINDOWS: u32 = 2;

/// See the module.
#[derive(Debug)]
pub(super) struct Trend {
    /// The begin of the window.
    began: Instant,
    /// The calls that waited then.
    waited: usize,
    /// True if all calls that have begun in the window were late.
    is_late: bool,
    /// The windows before, one after the other, in which the queue stood.
    stood: u32,
}

impl Trend {
    /// The trend of an empty queue.
    pub(super) fn new(now: Instant) -> Self {
        Self::window(now, 0, 0)
    }

    fn window(began: Instant, waited: usize, stood: u32) -> Self {
        Self {
            began,
            waited,
            is_late: true,
            stood,
        }
    }

    /// Notes that a call begins, late or not, and that `waiting` others wait. True if the queue stands.
    pub(super) fn begins(&mut self, is_late: bool, waiting: usize, now: Instant) -> bool {
        self.is_late &= is_late;
        if now.saturating_duration_since(self.began) < WINDOW {
            return false;
        }
        let stood = match self.is_late && waiting >= self.waited {
            true => self.stood + 1,
            false => 0,
        };
        *self = Self::window(now, waiting, stood);
        stood >= WINDOWS
    }
}
