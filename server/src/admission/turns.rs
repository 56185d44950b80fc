//! Turns: few calls compute at a time, and the others wait in an order of our own.
//!
//! Without it, all admitted calls would share the threads alike: under overload each of them is late, and the queue
//! stands where no code measures it. A call takes a turn for each slice of its work and gives it up whenever it waits.
//!
//! - *Fair:* the flow that has computed least goes first (start-time fair queueing). A flow that was idle gets no credit
//!   for that. P. Goyal, H. M. Vin, H. Cheng, *Start-time Fair Queuing*, SIGCOMM 1996.
//! - *Whole:* a call keeps its turn for [`MAX_WHOLE`] of work while all calls that wait are of many turns too. If they took
//!   turns, the calls of many connections would all end late.
//! - *First come, first served* within a flow. Calls that take longer than [`MAX_AT_ONCE`] wait apart after that time of
//!   work, and these and the others of the flow take turns: a short call does not wait for all long ones.
//! - *Measured:* a call that has not begun is refused once it has waited for too long: for the time of a burst, or for
//!   the target while the queue stands. It stands once all calls are late and it gets no [shorter](trend), or once it was
//!   not empty for the time of a burst; until no call has waited for half of the target for that time. If only the
//!   calls of one flow wait, and no others were late for the time of a burst, only the queue of that flow stands: fair
//!   turns keep it from delaying others.
//!   Bytes that a connection has not read yet wait too. B. Maurer, *Fail at Scale*, ACM Queue 13(8), 2015, after CoDel.
//!
//! The target is for long calls only: to refuse a short one costs as much as to answer it.
//!
//! A thread has one long turn at a time, or many short ones: they wait for it together while it reads and writes, and a
//! bystander waits for their sum at most.

mod queue;
mod trend;

use std::{
    sync::Arc,
    time::{Duration, Instant},
};

use parking_lot::Mutex;
use tokio::sync::oneshot;

use queue::{Flow, SHORT_TURNS, State, Waiter};
pub(super) use queue::{MAX_SHORT_NS, Stage};
use trend::Trend;

/// A call was refused because it waited for its first turn for too long, by the target that it carries.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Overloaded(pub(crate) Duration);

/// A call yields to the others of its flow after this much work.
pub(super) const MAX_AT_ONCE: Duration = Duration::from_millis(25);

/// A call keeps its turn before others of many turns until it has done this much work.
pub(super) const MAX_WHOLE: Duration = Duration::from_millis(4);

/// The result of the wait for a turn.
pub(super) type Granted = Result<Turn, Overloaded>;

/// The number of a flow: the calls that share its turns.
pub(super) type FlowNumber = u64;

/// See the module.
#[derive(Debug)]
pub(super) struct Turns {
    state: Mutex<State>,
    /// The time that a call waits for its first turn while the queue stands.
    target: Duration,
    /// The time that it waits otherwise.
    burst: Duration,
}

/// The right to compute, until it is dropped.
#[derive(Debug)]
pub(super) struct Turn {
    /// None once it is handed on.
    turns: Option<Arc<Turns>>,
    flow: FlowNumber,
    /// The short turns that it takes.
    size: usize,
    /// The time of its work, which is charged to the flow.
    took: Duration,
}

/// A request for a turn.
#[derive(Debug)]
pub(super) enum TurnRequest {
    /// There is a turn now.
    Granted(Turn),
    /// There will be one.
    Waits(oneshot::Receiver<Granted>),
}

impl Turns {
    /// Turns for `threads` threads.
    pub(super) fn new(threads: usize, target: Duration, burst: Duration) -> Arc<Self> {
        Arc::new(Self {
            state: Mutex::new(State {
                free: threads.max(1).saturating_mul(SHORT_TURNS),
                flows: Default::default(),
                order: Default::default(),
                clock_ns: 0,
                many_ns: 0,
                new: 0,
                was_empty: Instant::now(),
                trend: Trend::new(Instant::now()),
                stands_until: None,
                late: None,
                others_late: None,
                next_flow: 0,
                refused: 0,
            }),
            target,
            burst,
        })
    }

    /// The refusal of a call that waits for too long.
    pub(super) fn overloaded(&self) -> Overloaded {
        Overloaded(self.target)
    }

    /// The number of calls refused so far.
    pub(super) fn refused(&self) -> u64 {
        self.state.lock().refused
    }

    /// True if the turns of this flow are known to be long.
    pub(super) fn are_long(&self, flow: FlowNumber) -> bool {
        self.state.lock().are_long(flow)
    }

    /// Adds a flow, which is to be [closed](Self::close).
    pub(super) fn open(&self) -> FlowNumber {
        self.state.lock().open(false)
    }

    /// Adds a flow whose calls are not refused for their wait.
    pub(super) fn open_patient(&self) -> FlowNumber {
        self.state.lock().open(true)
    }

    /// Removes a flow whose calls have ended.
    pub(super) fn close(&self, flow: FlowNumber) {
        let mut state = self.state.lock();
        if let Some(mut closed) = state.flows.remove(&flow) {
            state.order.remove(&mut closed);
            let is_new = |waiting: &&Waiter| waiting.stage == Stage::New;
            state.new -= closed.waiting.iter().filter(is_new).count();
        }
    }

    /// Asks for a turn for a call of `flow`. Its connection has more to read for `behind`.
    pub(super) fn request(
        self: &Arc<Self>,
        flow: FlowNumber,
        stage: Stage,
        behind: Duration,
        now: Instant,
    ) -> Result<TurnRequest, Overloaded> {
        let mut state = self.state.lock();
        // A patient call waits like one that has computed for long: it is not refused, and its wait refuses no others.
        let stage = match state.is_patient(flow) && stage == Stage::New {
            true => Stage::Demoted,
            false => stage,
        };
        let size = state.size(flow, stage);
        let is_free = state.order.is_empty() && state.free >= size;
        state.note_empty(flow, now);
        if stage == Stage::New && size == SHORT_TURNS {
            // The flow's calls already wait for too long; one more is refused now instead of later.
            let wait = state.flows.get(&flow).map_or(Duration::ZERO, Flow::wait);
            let stands = self.stands(&mut state, flow, behind, now);
            let is_late = behind.max(2 * wait) > self.target;
            if stands && is_late {
                self.refuse(&mut state, flow, now);
                return Err(self.overloaded());
            }
        }
        if is_free {
            state.free -= size;
            state.begin(flow);
            return Ok(TurnRequest::Granted(self.turn(flow, size)));
        }
        Ok(TurnRequest::Waits(state.enqueue(flow, stage, now)))
    }

    /// Charges the flow of `turn` for work that goes on. The turn is handed on if others wait that go before it.
    pub(super) fn yield_turn(
        self: &Arc<Self>,
        mut turn: Turn,
        took: Duration,
        stage: Stage,
        now: Instant,
    ) -> TurnRequest {
        let mut state = self.state.lock();
        state.charge(turn.flow, took);
        state.note_empty(turn.flow, now);
        // A turn that goes on is a long one.
        let more = SHORT_TURNS - turn.size;
        let goes_on = match stage {
            Stage::Begun => !state.order.has_brief(),
            _ => state.order.is_empty(),
        };
        if goes_on && state.free >= more {
            state.free -= more;
            turn.size = SHORT_TURNS;
            return TurnRequest::Granted(turn);
        }
        let granted = state.enqueue(turn.flow, stage, now);
        drop(state);
        // Its work is charged already.
        turn.turns = None;
        self.release(turn.flow, turn.size, Duration::ZERO, now);
        TurnRequest::Waits(granted)
    }

    /// True if the queue stands, where a call of `flow` has waited for `wait`. Then the target bounds the waits.
    fn stands(&self, state: &mut State, flow: FlowNumber, wait: Duration, now: Instant) -> bool {
        let stands = state.stands(flow, self.burst, now);
        if wait > self.burst || (stands && 2 * wait > self.target) {
            state.stand(flow, self.burst, now);
        }
        stands || wait > self.burst
    }

    fn refuse(&self, state: &mut State, flow: FlowNumber, now: Instant) {
        state.refused += 1;
        state.stand(flow, self.burst, now);
    }

    fn turn(self: &Arc<Self>, flow: FlowNumber, size: usize) -> Turn {
        Turn {
            turns: Some(Arc::clone(self)),
            flow,
            size,
            took: Duration::ZERO,
        }
    }

    /// Charges `flow` for a turn, and hands it on, or keeps it for later if no call waits.
    fn release(self: &Arc<Self>, flow: FlowNumber, size: usize, took: Duration, now: Instant) {
        let mut state = self.state.lock();
        state.charge(flow, took);
        state.free += size;
        while let Some((flow, size, next)) = state.next(now) {
            let wait = now.saturating_duration_since(next.since);
            let is_new = next.stage == Stage::New;
            let stands = size == SHORT_TURNS && !state.is_patient(flow) && {
                let waiting = state.new;
                if is_new && state.trend.begins(wait > self.target, waiting, now) {
                    state.stand(flow, self.burst, now);
                }
                self.stands(&mut state, flow, wait, now)
            };
            let limit = if stands { self.target } else { self.burst };
            let is_late = is_new && wait > limit;
            if is_late {
                self.refuse(&mut state, flow, now);
            }
            let granted = match is_late {
                true => Err(self.overloaded()),
                false => Ok(self.turn(flow, size)),
            };
            // A turn that its caller has left, and that is dropped here, locks the state again.
            drop(state);
            let sent = next.granted.send(granted);
            state = self.state.lock();
            match sent {
                Ok(()) if !is_late => continue,
                Err(Ok(mut turn)) => turn.turns = None,
                Ok(()) | Err(Err(_)) => {}
            }
            state.free += size;
        }
        state.note_empty(flow, now);
    }
}

impl Turn {
    /// True if its thread has many turns at a time.
    pub(super) fn is_short(&self) -> bool {
        self.size < SHORT_TURNS
    }

    /// True if it is a long one, and the turns of its flow are known to be long.
    pub(super) fn is_long(&self) -> bool {
        let turns = self.turns.as_ref().filter(|_| !self.is_short());
        turns.is_some_and(|turns| turns.are_long(self.flow))
    }

    /// Ends the turn after `took` of work.
    pub(super) fn end(mut self, took: Duration) {
        self.took = took;
    }
}

impl Drop for Turn {
    fn drop(&mut self) {
        if let Some(turns) = self.turns.take() {
            turns.release(self.flow, self.size, self.took, Instant::now());
        }
    }
}

#[cfg(test)]
mod load_tests;
#[cfg(test)]
mod tests;
