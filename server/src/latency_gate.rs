//! A latency gate: calls are answered inline while recent answers took less time than a handover to another thread.

use std::{
    pin::Pin,
    sync::atomic::{AtomicU64, Ordering::Relaxed},
    task::{Context, Poll, Waker},
    time::{Duration, Instant},
};

/// A sample counts for at most this many limits: a thread that was preempted measures the scheduler, not the answer.
const MAX_SAMPLE_LIMITS: u64 = 4;
/// The running mean covers about this many samples.
const MEAN_SAMPLES: u64 = 8;
/// While the gate is closed, the mean decays over about this many answers.
const DECAY_STEPS: u64 = 64;

/// A running mean of answer times, and the limit for it. Threads share it without a lock; a race loses one sample of
/// many.
#[derive(Debug)]
pub(crate) struct LatencyGate {
    limit_ns: u64,
    mean_ns: AtomicU64,
}

impl LatencyGate {
    /// A gate that is open until samples show that answers take longer than `limit`.
    pub(crate) const fn new(limit: Duration) -> Self {
        Self {
            limit_ns: limit.as_nanos() as u64,
            mean_ns: AtomicU64::new(0),
        }
    }

    /// Polls `answering` once if the gate is open. If it is pending, await it on any thread: the next poll sets its
    /// waker.
    pub(crate) fn attempt<F: Future + ?Sized>(&self, answering: Pin<&mut F>) -> Poll<F::Output> {
        if !self.is_open() {
            return Poll::Pending;
        }
        let began = Instant::now();
        let polled = answering.poll(&mut Context::from_waker(Waker::noop()));
        self.record(began.elapsed());
        polled
    }

    /// True if the mean is within the limit. A closed gate takes no samples, so each refusal decays the mean: the gate
    /// reopens now and then for one sample.
    fn is_open(&self) -> bool {
        let mean = self.mean_ns.load(Relaxed);
        if mean <= self.limit_ns {
            return true;
        }
        self.mean_ns.store(mean - mean / DECAY_STEPS, Relaxed);
        false
    }

    /// Adds a sample to the mean.
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

    const MAX_LATENCY: Duration = Duration::from_micros(50);

    #[test]
    fn one_interrupted_answer_does_not_close_the_gate() {
        let gate = LatencyGate::new(MAX_LATENCY);
        for round in 0..1000 {
            assert!(gate.is_open(), "{round}");
            let interrupted = round % 100 == 99;
            gate.record(if interrupted {
                100 * MAX_LATENCY
            } else {
                MAX_LATENCY / 5
            });
        }
    }

    #[test]
    fn long_answers_close_the_gate_and_are_seldom_sampled() {
        let gate = LatencyGate::new(MAX_LATENCY);
        let mut expected = 0;
        for _ in 0..1000 {
            if gate.is_open() {
                expected += 1;
                gate.record(20 * MAX_LATENCY);
            }
        }
        assert!((1..60).contains(&expected), "{expected}");
    }

    #[test]
    fn the_gate_reopens_when_answers_are_brief_again() {
        let gate = LatencyGate::new(MAX_LATENCY);
        while gate.is_open() {
            gate.record(20 * MAX_LATENCY);
        }
        while !gate.is_open() {}
        gate.record(MAX_LATENCY / 5);
        assert!(gate.is_open());
    }
}
