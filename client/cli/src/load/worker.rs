//! A worker: a thread that makes calls, one at a time, through a target of its own.

use std::{
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
    thread,
    time::{Duration, Instant},
};

use rand::RngExt;
use tokio::sync::watch;
use wayfold::Error;

use super::{
    mix::Verb,
    record::{Cause, Kind, Recorder},
    schedule::{Schedule, Ticket, latency},
    settings::Phase,
    states::Sampler,
    target::{Request, Target},
};

/// The state that the workers of a run share.
#[derive(Debug)]
pub(super) struct Workload {
    pub(super) sampler: Sampler,
    /// The tag of the points that the run stores.
    pub(super) tag: u64,
    /// The ids that `get` reads.
    pub(super) ids: Vec<u64>,
}

/// One phase as its workers see it.
#[derive(Debug)]
pub(super) struct Task {
    pub(super) workload: Arc<Workload>,
    pub(super) phase: Phase,
    /// The number of the phase in the run, 0 for the warm-up. It goes into the random numbers.
    pub(super) number: u64,
    pub(super) schedule: Schedule,
    pub(super) began: Instant,
    pub(super) recorder: Recorder,
    /// The time from the beginning to the end of the last worker, in nanoseconds.
    ended: AtomicU64,
}

impl Task {
    pub(super) fn new(workload: Arc<Workload>, phase: Phase, number: u64, step: Duration) -> Task {
        // The workers' threads have started by then.
        const START: Duration = Duration::from_millis(5);
        Task {
            workload,
            number,
            schedule: Schedule::new(phase.rate, phase.duration, phase.calls),
            began: Instant::now() + START,
            recorder: Recorder::new(phase.workers, step),
            ended: AtomicU64::new(0),
            phase,
        }
    }

    /// The time that the phase took, once its workers have ended. An open loop that was not `cut` short took all of its
    /// time, also if its last call was answered before the end.
    pub(super) fn elapsed(&self, cut: bool) -> Duration {
        let ended = Duration::from_nanos(self.ended.load(Ordering::Relaxed));
        match (self.phase.rate, self.phase.duration, self.phase.calls) {
            (Some(_), Some(duration), None) if !cut => ended.max(duration),
            _ => ended,
        }
    }
}

pub(super) struct Worker {
    pub(super) number: usize,
    pub(super) target: Box<dyn Target>,
    /// True once the run ends early.
    pub(super) stopped: watch::Receiver<bool>,
}

impl Worker {
    /// Makes calls until the phase is over or the run is stopped. A call under way is finished.
    pub(super) fn run(&mut self, task: &Task) {
        self.work(task);
        let ended = u64::try_from(task.began.elapsed().as_nanos()).unwrap_or(u64::MAX);
        task.ended.fetch_max(ended, Ordering::Relaxed);
    }

    fn work(&mut self, task: &Task) {
        if self.wait(task.began) {
            return;
        }
        while !*self.stopped.borrow() {
            let Some(ticket) = task.schedule.take(task.began.elapsed()) else {
                return;
            };
            let due = task.began.checked_add(ticket.due);
            if due.is_some_and(|due| self.wait(due)) {
                return;
            }
            let failed = self.call(task, ticket);
            // In an open loop the next call is due at its time, whatever became of this one.
            if let (Some(pause), None) = (failed, task.phase.rate)
                && self.wait(Instant::now() + pause)
            {
                return;
            }
        }
    }

    /// Makes a call and records it. After a failure it returns the pause that a patient caller makes.
    fn call(&mut self, task: &Task, mut ticket: Ticket) -> Option<Duration> {
        let stream = (task.number << PHASE_BITS) | ticket.number;
        let mut rng = task.workload.sampler.stream(stream);
        let (phase, workload) = (&task.phase, &task.workload);
        let verb = phase.mix.verb(rng.random_range(0..phase.mix.total()));
        let (rows, count) = match verb {
            Verb::Get => (Vec::new(), phase.batch.min(workload.ids.len())),
            _ => (workload.sampler.rows(&mut rng, phase.batch), phase.batch),
        };
        let request = match verb {
            Verb::Insert => Request::Insert {
                rows: &rows,
                tag: workload.tag,
            },
            Verb::Knn => Request::Knn {
                rows: &rows,
                k: phase.k,
            },
            Verb::Stream => Request::Stream {
                rows: &rows,
                k: phase.k,
            },
            Verb::Query => Request::Query {
                rows: &rows,
                radius: phase.radius.unwrap_or_default(),
            },
            Verb::Get => {
                let first = rng.random_range(0..=workload.ids.len() - count);
                Request::Get {
                    ids: &workload.ids[first..first + count],
                }
            }
        };
        if phase.rate.is_none() {
            // The drawing of its states is no part of a call that begins when it can.
            ticket.due = task.began.elapsed();
        }
        let outcome = self.target.call(&request);
        let ended = task.began.elapsed();
        let latency = latency(ticket, ended);
        task.recorder.write(self.number, ended, |tally| {
            tally.record(verb, count, latency, outcome.as_ref().err());
        });
        outcome.err().and_then(|error| pause(&error))
    }

    /// Waits until a time. True if the run is stopped before.
    fn wait(&mut self, until: Instant) -> bool {
        // A timer of the runtime is up to a millisecond late; the thread waits for the last part by itself.
        const LAST: Duration = Duration::from_millis(2);
        let now = Instant::now();
        if until > now + LAST && self.target.idle(until - LAST, &mut self.stopped) {
            return true;
        }
        loop {
            let left = until.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return *self.stopped.borrow();
            }
            thread::park_timeout(left);
        }
    }
}

/// A call's random numbers are named by its number in these lowest bits, and by its phase above them.
const PHASE_BITS: u32 = 40;

/// The pause after a failure in a closed loop: as long as the server asks for, and a tenth of a second without a server.
fn pause(error: &Error) -> Option<Duration> {
    const LONGEST: Duration = Duration::from_secs(1);
    const LOST: Duration = Duration::from_millis(100);
    match error {
        Error::Refused(refusal) => refusal.retry_after.map(|pause| pause.min(LONGEST)),
        error if Cause::of(error).kind == Kind::Lost => Some(LOST),
        _ => None,
    }
}
