//! Whether what is asked of late is answered in less time than it takes to hand it to another thread.

use std::{
    pin::Pin,
    sync::atomic::{AtomicU64, Ordering::Relaxed},
    task::{Context, Poll, Waker},
    time::{Duration, Instant},
};

/// What one measurement counts for at most, in limits: a thread that lost its processor for a while says little.
const MAX_SAMPLE_LIMITS: u64 = 4;
/// How many measurements a mean is over, about.
const MEAN_SAMPLES: u64 = 8;
/// In how many steps, about, what is not measured is forgotten.
const DECAY_STEPS: u64 = 64;

/// A running mean of how long answers take, and a limit for it. Shared by threads, each of which may lose what another
/// measured: that is one measurement of many.
#[derive(Debug)]
pub(crate) struct LatencyGate {
    limit_ns: u64,
    mean_ns: AtomicU64,
}

impl LatencyGate {
    /// Nothing is known yet; answers are brief until they were found not to be.
    pub(crate) const fn new(limit: Duration) -> Self {
        Self {
            limit_ns: limit.as_nanos() as u64,
            mean_ns: AtomicU64::new(0),
        }
    }

    /// The answer, if it is expected to be brief, and has to wait for nothing. Otherwise `answering` is to be awaited, on
    /// whatever thread: its waker is that of whoever polls it next.
    pub(crate) fn attempt<F: Future + ?Sized>(&self, answering: Pin<&mut F>) -> Poll<F::Output> {
        if !self.is_open() {
            return Poll::Pending;
        }
        let began = Instant::now();
        let polled = answering.poll(&mut Context::from_waker(Waker::noop()));
        self.record(began.elapsed());
        polled
    }

    /// Whether the next answer is expected to be brief. Where it is not, it is not measured either, and every now and then
    /// one is expected to be, so that it is found out when times change.
    fn is_open(&self) -> bool {
        let mean = self.mean_ns.load(Relaxed);
        if mean <= self.limit_ns {
            return true;
        }
        self.mean_ns.store(mean - mean / DECAY_STEPS, Relaxed);
        false
    }

    /// Takes note of how long an answer took.
    fn record(&self, taken: Duration) {
        let taken = u64::try_from(taken.as_nanos()).unwrap_or(u64::MAX);
        let taken = taken.min(MAX_SAMPLE_LIMITS * self.limit_ns);
        let mean = self.mean_ns.load(Relaxed);
        let mean = mean - mean / MEAN_SAMPLES + taken / MEAN_SAMPLES;
        self.mean_ns.store(mean, Relaxed);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LIMIT: Duration = Duration::from_micros(50);

    #[test]
    fn brief_answers_stay_so_even_if_one_was_interrupted() {
        let gate = LatencyGate::new(LIMIT);
        for round in 0..1000 {
            assert!(gate.is_open(), "{round}");
            let interrupted = round % 100 == 99;
            gate.record(if interrupted { 100 * LIMIT } else { LIMIT / 5 });
        }
    }

    #[test]
    fn long_answers_are_found_out_soon_and_tried_seldom() {
        let gate = LatencyGate::new(LIMIT);
        let mut expected = 0;
        for _ in 0..1000 {
            if gate.is_open() {
                expected += 1;
                gate.record(20 * LIMIT);
            }
        }
        assert!((1..60).contains(&expected), "{expected}");
    }

    #[test]
    fn it_is_noticed_when_they_are_brief_again() {
        let gate = LatencyGate::new(LIMIT);
        while gate.is_open() {
            gate.record(20 * LIMIT);
        }
        while !gate.is_open() {}
        gate.record(LIMIT / 5);
        assert!(gate.is_open());
    }
}
