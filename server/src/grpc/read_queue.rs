//! The connections of a listener that wait to read.
//!
//! A connection that sends much reads in turns, so that its calls do not pile up in the runtime: what waits, waits in
//! sockets. A turn is given while few tasks wait for a thread. Among patient connections it goes to the one that came first,
//! and among those whose calls have short deadlines to the one that came last. Under overload some of these are then read
//! as fast as they send, and the calls of the others expire. If all were read in the same measure, all calls would come
//! late.
//!
//! After [`MAX_WAIT`] a connection has a turn under any load. One with short deadlines is late from then on: it has a turn
//! every [`MAX_WAIT`], and more turns while only late connections wait. Every [`ROTATION`] the one that has been late for
//! the longest returns to the others.

use std::{collections::VecDeque, future::poll_fn, mem, task::Poll, time::Duration};

use parking_lot::Mutex;
use tokio::{
    runtime::Handle,
    sync::{
        Notify,
        oneshot::{self, Receiver, Sender},
    },
    task::yield_now,
    time::Instant,
};

/// While more tasks than this wait in the global queue of the runtime, only connections that have waited for [`MAX_WAIT`]
/// have turns. Each call is a task, a cancelled one too. Without this limit up to 89,000 tasks waited, and health checks
/// took seconds.
const MAX_WAITING_TASKS: usize = 16;

/// The longest wait while at most a few hundred connections are late. After it a connection has a turn under any load, so a
/// large request still arrives at about 80 KiB a second. The wait is shorter than the default of `admission.burst_ms`,
/// because admission refuses a long call that waited unread for that time.
const MAX_WAIT: Duration = Duration::from_millis(800);

/// Late connections return one by one, because each takes the place of another. With an interval of 100 ms half as many
/// calls with short deadlines were answered in time.
const ROTATION: Duration = Duration::from_secs(1);

/// See the module.
#[derive(Debug)]
pub(super) struct ReadQueue {
    waiting: Mutex<Waiting>,
    has_come: Notify,
}

/// Each list is in the order in which its connections came.
#[derive(Debug)]
struct Waiting {
    patient: VecDeque<Waiter>,
    /// Those whose calls have short deadlines.
    hurried: VecDeque<Waiter>,
    /// Those that are late, and patient ones that have waited for as long.
    late: VecDeque<Waiter>,
    /// True if a connection of `patient` had a turn after the last one of `hurried`: the two lists take turns.
    was_patient: bool,
    /// The last time that a late connection returned.
    rotated_at: Instant,
}

#[derive(Debug)]
struct Waiter {
    since: Instant,
    is_hurried: bool,
    late_since: Option<Instant>,
    /// Takes the time since which the connection is late.
    granted: Sender<Option<Instant>>,
}

impl Default for ReadQueue {
    fn default() -> Self {
        let waiting = Waiting {
            patient: VecDeque::new(),
            hurried: VecDeque::new(),
            late: VecDeque::new(),
            was_patient: false,
            rotated_at: Instant::now(),
        };
        Self {
            waiting: Mutex::new(waiting),
            has_come: Notify::new(),
        }
    }
}

impl ReadQueue {
    /// True while only connections that have waited for long have turns.
    pub(super) fn is_busy() -> bool {
        Handle::current().metrics().global_queue_depth() > MAX_WAITING_TASKS
    }

    /// Waits for a turn, which tells the time since which the connection is late. `late_since` is that of its last turn.
    pub(super) fn enter(
        &self,
        is_hurried: bool,
        late_since: Option<Instant>,
    ) -> Receiver<Option<Instant>> {
        let (granted, receiver) = oneshot::channel();
        let waiter = Waiter {
            since: Instant::now(),
            is_hurried,
            late_since,
            granted,
        };
        self.waiting.lock().push(waiter);
        self.has_come.notify_one();
        receiver
    }

    /// Gives turns, one at a time under load, otherwise one for each thread of the runtime, and lets other tasks run before.
    pub(super) async fn give_turns(&self) {
        let threads = Handle::current().metrics().num_workers();
        loop {
            self.has_come.notified().await;
            while !self.waiting.lock().is_empty() {
                match Self::is_busy() {
                    // While this task waits, its thread runs the tasks of the global queue.
                    true => yield_now().await,
                    false => run_others().await,
                }
                for _ in 0..threads {
                    let is_busy = Self::is_busy();
                    if !self.give_turn(is_busy) || is_busy {
                        break;
                    }
                }
            }
        }
    }

    /// Gives the next turn. False if no connection may have one.
    fn give_turn(&self, is_busy: bool) -> bool {
        let (mut waiting, now) = (self.waiting.lock(), Instant::now());
        while let Some(waiter) = waiting.next(is_busy, now) {
            // A connection that has ended needs none.
            if waiter.granted.send(waiter.late_since).is_ok() {
                return true;
            }
        }
        false
    }
}

impl Waiting {
    fn is_empty(&self) -> bool {
        self.patient.is_empty() && self.hurried.is_empty() && self.late.is_empty()
    }

    fn push(&mut self, waiter: Waiter) {
        let list = match (waiter.late_since, waiter.is_hurried) {
            (Some(_), _) => &mut self.late,
            (None, true) => &mut self.hurried,
            (None, false) => &mut self.patient,
        };
        list.push_back(waiter);
    }

    fn next(&mut self, is_busy: bool, now: Instant) -> Option<Waiter> {
        let is_due = |waiter: &Waiter| now.duration_since(waiter.since) >= MAX_WAIT;
        for in_time in [&mut self.patient, &mut self.hurried] {
            while in_time.front().is_some_and(is_due) {
                let mut waiter = in_time.pop_front()?;
                waiter.late_since = waiter.is_hurried.then_some(now);
                let is_before = |late: &Waiter| late.since <= waiter.since;
                let place = self.late.partition_point(is_before);
                self.late.insert(place, waiter);
            }
        }
        if now.duration_since(self.rotated_at) >= ROTATION {
            self.late.retain(|waiter| !waiter.granted.is_closed());
            let late = self.late.iter().enumerate();
            let late = late.filter(|(_, waiter)| waiter.late_since.is_some());
            let first = late.min_by_key(|(_, waiter)| waiter.late_since);
            if let Some((first, _)) = first {
                self.rotated_at = now;
                let mut waiter = self.late.remove(first)?;
                waiter.late_since = None;
                return Some(waiter);
            }
        }
        if self.late.front().is_some_and(is_due) {
            return self.late.pop_front();
        }
        if is_busy {
            return None;
        }
        self.was_patient =
            !self.patient.is_empty() && (!self.was_patient || self.hurried.is_empty());
        match self.was_patient {
            true => self.patient.pop_front(),
            false => self.hurried.pop_back().or_else(|| self.late.pop_front()),
        }
    }
}

/// Lets the tasks run that wait for this thread. The runtime would look for bytes too before it resumes a task that
/// yields.
async fn run_others() {
    let mut has_waited = false;
    poll_fn(|context| match mem::replace(&mut has_waited, true) {
        true => Poll::Ready(()),
        false => {
            context.waker().wake_by_ref();
            Poll::Pending
        }
    })
    .await;
}

#[cfg(test)]
mod tests;
#[cfg(test)]
pub(super) use tests::let_tasks_wait;
