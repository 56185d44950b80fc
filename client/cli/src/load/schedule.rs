//! The times at which calls are due, and the end of a phase.

use std::{
    sync::atomic::{AtomicBool, AtomicU64, Ordering},
    time::Duration,
};

/// The calls of a phase. Times count from its beginning.
///
/// In an open loop call n is due at n / rate, whatever became of the calls before it. In a closed loop a call is due when
/// a worker has its hands free.
#[derive(Debug)]
pub(super) struct Schedule {
    /// Calls per second over all workers; `None` in a closed loop.
    rate: Option<f64>,
    duration: Option<Duration>,
    calls: Option<u64>,
    next: AtomicU64,
    ended: AtomicBool,
}

/// A call to make.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Ticket {
    /// Its number, from 0.
    pub(super) number: u64,
    /// The time from which its latency counts.
    pub(super) due: Duration,
}

impl Schedule {
    pub(super) fn new(
        rate: Option<f64>,
        duration: Option<Duration>,
        calls: Option<u64>,
    ) -> Schedule {
        Schedule {
            rate,
            duration,
            calls,
            next: AtomicU64::new(0),
            ended: AtomicBool::new(false),
        }
    }

    /// The next call of any worker; `None` if the phase is over at the time `now`.
    pub(super) fn take(&self, now: Duration) -> Option<Ticket> {
        let is_over = |time| self.duration.is_some_and(|duration| time >= duration);
        if is_over(now) || self.ended.load(Ordering::Relaxed) {
            return None;
        }
        let number = self.next.fetch_add(1, Ordering::Relaxed);
        let due = self.rate.map_or(now, |rate| due(number, rate));
        let is_left = self.calls.is_none_or(|calls| number < calls);
        (is_left && !is_over(due)).then_some(Ticket { number, due })
    }

    /// No further call begins.
    pub(super) fn end(&self) {
        self.ended.store(true, Ordering::Relaxed);
    }

    /// The calls of an open loop that are due in the first `elapsed` of the phase; `None` in a closed loop.
    pub(super) fn due_by(&self, elapsed: Duration) -> Option<u64> {
        let rate = self.rate?;
        let elapsed = self.duration.map_or(elapsed, |end| end.min(elapsed));
        let due = due_count(elapsed, rate);
        Some(self.calls.map_or(due, |calls| calls.min(due)))
    }
}

/// The time at which call `number` is due.
fn due(number: u64, rate: f64) -> Duration {
    let seconds = number as f64 / rate;
    // A rate of 1e-300 makes the second call due after the end of any clock.
    Duration::try_from_secs_f64(seconds).unwrap_or(Duration::MAX)
}

/// The number of calls that are due before `end`.
fn due_count(end: Duration, rate: f64) -> u64 {
    let about = (end.as_secs_f64() * rate) as u64;
    // Rounding moves the count by one at most.
    let candidates = about.saturating_sub(1)..=about.saturating_add(1);
    let not_due = candidates.clone().find(|number| due(*number, rate) >= end);
    not_due.unwrap_or(about.saturating_add(2))
}

/// The latency of a call that ended at `ended`: it counts from the time at which it was due, also if it began later.
pub(super) fn latency(ticket: Ticket, ended: Duration) -> Duration {
    ended.saturating_sub(ticket.due)
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: Duration = Duration::from_millis(1);

    #[test]
    fn calls_are_due_at_even_distances_whenever_they_are_taken() {
        let schedule = Schedule::new(Some(200.0), Some(50 * MS), None);
        // The workers are late from the second call on.
        let taken: Vec<_> = [0, 31, 32, 33, 34, 35, 36, 37, 38, 39, 49]
            .into_iter()
            .map_while(|now| schedule.take(now * MS))
            .collect();
        let due: Vec<_> = taken.iter().map(|ticket| ticket.due.as_millis()).collect();
        assert_eq!(due, [0, 5, 10, 15, 20, 25, 30, 35, 40, 45]);
        assert_eq!(taken[9].number, 9);
    }

    #[test]
    fn a_late_worker_adds_its_lateness_to_the_latency() {
        let schedule = Schedule::new(Some(100.0), None, Some(3));
        let latencies: Vec<_> = [(0, 35), (35, 36), (36, 37)]
            .into_iter()
            .filter_map(|(began, ended)| Some((schedule.take(began * MS)?, ended * MS)))
            .map(|(ticket, ended)| latency(ticket, ended).as_millis())
            .collect();
        // Each of the last two took 1 ms, but was due at 10 and 20 ms.
        assert_eq!(latencies, [35, 26, 17]);
    }

    #[test]
    fn a_closed_loop_has_calls_due_when_they_are_taken() {
        let schedule = Schedule::new(None, Some(10 * MS), None);
        let ticket = schedule.take(7 * MS).unwrap();
        assert_eq!((ticket.number, ticket.due), (0, 7 * MS));
        assert_eq!(latency(ticket, 9 * MS), 2 * MS);
        assert_eq!(schedule.take(10 * MS), None);
        assert_eq!(schedule.due_by(MS), None);
    }

    #[test]
    fn a_number_of_calls_ends_a_phase_after_exactly_these() {
        for rate in [None, Some(1e9)] {
            let schedule = Schedule::new(rate, None, Some(5));
            let taken = (0..9).filter(|_| schedule.take(MS).is_some());
            assert_eq!(taken.count(), 5);
        }
    }

    #[test]
    fn the_backlog_of_a_phase_that_is_over_is_not_begun() {
        let schedule = Schedule::new(Some(1000.0), Some(100 * MS), None);
        assert!(schedule.take(99 * MS).is_some());
        assert_eq!(schedule.take(100 * MS), None);
        assert_eq!(schedule.due_by(100 * MS), Some(100));
        // A run that was ended early.
        assert_eq!(schedule.due_by(10 * MS), Some(10));
        let limited = Schedule::new(Some(1000.0), None, Some(4));
        assert_eq!(limited.due_by(100 * MS), Some(4));
    }

    #[test]
    fn the_schedule_gives_the_number_of_due_calls() {
        for rate in [0.3, 1.0, 3.0, 7.0, 999.0, 12_345.6] {
            for end in [MS, 100 * MS, 333 * MS, 1000 * MS, 7777 * MS] {
                let schedule = Schedule::new(Some(rate), Some(end), None);
                let taken = (0..).take_while(|_| schedule.take(Duration::ZERO).is_some());
                let taken = taken.count() as u64;
                assert_eq!(schedule.due_by(2 * end), Some(taken), "{rate} {end:?}");
            }
        }
        assert_eq!(due(1, 1e-300), Duration::MAX);
    }
}
