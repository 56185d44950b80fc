//! Turns: few calls compute at a time, and the others wait in an order of our own.
//!
//! Without it, all admitted calls would share the threads alike: under overload each of them is late, and the queue
//! stands where nobody measures it. A call takes a turn for each slice of its work and gives it up whenever it waits.
//!
//! - *Fair:* the flow that has computed least goes first (start-time fair queueing). A flow that was idle gets no credit
//!   for that. P. Goyal, H. M. Vin, H. Cheng, *Start-time Fair Queuing*, SIGCOMM 1996.
//! - *First come, first served* within a flow. Calls that take longer than [`MAX_AT_ONCE`] wait apart after that time of
//!   work, and these and the others of the flow take turns: a short call does not wait for all long ones.
//! - *Measured:* a call that has not begun is refused once it has waited for too long: for the time of a burst, or for
//!   the target while the queue stands. It stands once it was not empty for the time of a burst, until no call was late
//!   for that time. What a connection has not read yet waits too. B. Maurer, *Fail at Scale*, ACM Queue 13(8), 2015,
//!   after CoDel.
//!
//! The target is for long calls only: to refuse a short one costs as much as to answer it.
//!
//! A thread has one long turn at a time, or many short ones: they wait for it together while it reads and writes, and a
//! bystander waits for their sum at most.

use std::{
    collections::{BTreeSet, HashMap, VecDeque},
    sync::Arc,
    time::{Duration, Instant},
};

use parking_lot::Mutex;
use tokio::sync::oneshot;

/// A call was refused because it waited for its first turn for too long, by the target that it carries.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Overloaded(pub(crate) Duration);

/// The most short turns at a time for each thread.
const SHORT_TURNS: usize = 128;

/// A flow whose turns take longer on average has long turns.
const MAX_SHORT_NS: u64 = 50_000;

/// A call yields to the others of its flow after this much work.
pub(super) const MAX_AT_ONCE: Duration = Duration::from_millis(25);

/// The mean of a flow's turns covers about this many of them.
const MEAN_TURNS: u64 = 8;

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

#[derive(Debug)]
struct State {
    /// The short turns that nobody has. A long one takes [`SHORT_TURNS`] of them.
    free: usize,
    flows: HashMap<FlowNumber, Flow>,
    /// The flows with waiting calls, in the order of their turns: by `used_ns`, then by number.
    order: BTreeSet<(u64, FlowNumber)>,
    /// The `used_ns` at which the last turn began.
    clock_ns: u64,
    /// The waiting calls that have not begun.
    new: usize,
    /// The last time that there were none.
    was_empty: Instant,
    /// The queue stands until then.
    stands_until: Instant,
    next_flow: FlowNumber,
    /// The calls that were refused.
    refused: u64,
}

#[derive(Debug, Default)]
struct Flow {
    /// The time that its turns have taken, and what others took while it was idle.
    used_ns: u64,
    /// The mean time of its turns; None before the first.
    mean_ns: Option<u64>,
    /// The wait of the last of its calls that has begun.
    last_wait: Duration,
    /// Those that have not begun, after one that goes on.
    waiting: VecDeque<Waiting>,
    /// Those that have computed for long.
    behind: VecDeque<Waiting>,
    /// True if the next turn goes to `behind`: they and the others take turns.
    behind_is_due: bool,
}

#[derive(Debug)]
struct Waiting {
    since: Instant,
    stage: Stage,
    granted: oneshot::Sender<Granted>,
}

/// How far a call has come.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Stage {
    /// It has not begun, and can be refused.
    New,
    /// It goes on before the other calls of its flow.
    GoesOn,
    /// It goes on after them, as one of those that have computed for long.
    GoesBehind,
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
                flows: HashMap::new(),
                order: BTreeSet::new(),
                clock_ns: 0,
                new: 0,
                was_empty: Instant::now(),
                stands_until: Instant::now(),
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

    /// Adds a flow, which is to be [closed](Self::close).
    pub(super) fn open(&self) -> FlowNumber {
        let mut state = self.state.lock();
        let number = state.next_flow;
        state.next_flow += 1;
        state.flows.insert(number, Flow::default());
        number
    }

    /// Removes a flow whose calls have ended.
    pub(super) fn close(&self, flow: FlowNumber) {
        let mut state = self.state.lock();
        if let Some(closed) = state.flows.remove(&flow) {
            state.order.remove(&(closed.used_ns, flow));
            let is_new = |waiting: &&Waiting| waiting.stage == Stage::New;
            state.new -= closed.waiting.iter().filter(is_new).count();
        }
    }

    /// Asks for a turn for a call of `flow`. Its connection has more to read for `behind`.
    pub(super) fn ask(
        self: &Arc<Self>,
        flow: FlowNumber,
        stage: Stage,
        behind: Duration,
        now: Instant,
    ) -> Result<TurnRequest, Overloaded> {
        let mut state = self.state.lock();
        let size = state.size(flow, stage);
        let is_free = state.order.is_empty() && state.free >= size;
        state.look(now);
        if stage == Stage::New && size == SHORT_TURNS {
            // The flow's calls already wait for too long; one more is refused now instead of later.
            let wait = state.flows.get(&flow).map_or(Duration::ZERO, Flow::wait);
            let (limit, stands) = self.limit(&mut state, behind, now);
            if stands && (behind > limit || 2 * wait > limit) {
                self.refuse(&mut state, now);
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

    /// Charges the flow of `turn` for work that goes on. The turn is handed on if others wait.
    pub(super) fn give_way(
        self: &Arc<Self>,
        mut turn: Turn,
        took: Duration,
        stage: Stage,
    ) -> TurnRequest {
        let now = Instant::now();
        let mut state = self.state.lock();
        state.charge(turn.flow, took);
        state.look(now);
        // A turn that goes on is a long one.
        let more = SHORT_TURNS - turn.size;
        if state.order.is_empty() && state.free >= more {
            state.free -= more;
            turn.size = SHORT_TURNS;
            return TurnRequest::Granted(turn);
        }
        let granted = state.enqueue(turn.flow, stage, now);
        drop(state);
        turn.took = Duration::ZERO;
        TurnRequest::Waits(granted)
    }

    /// The longest wait for a first turn where some call has waited for `wait`, and whether the queue stands.
    fn limit(&self, state: &mut State, wait: Duration, now: Instant) -> (Duration, bool) {
        let standing = now.saturating_duration_since(state.was_empty).max(wait);
        let is_late = now < state.stands_until && 2 * wait > self.target;
        if standing > self.burst || is_late {
            state.stands_until = now + self.burst;
        }
        match now < state.stands_until {
            true => (self.target, true),
            false => (self.burst, false),
        }
    }

    fn refuse(&self, state: &mut State, now: Instant) {
        state.refused += 1;
        state.stands_until = now + self.burst;
    }

    fn turn(self: &Arc<Self>, flow: FlowNumber, size: usize) -> Turn {
        Turn {
            turns: Some(Arc::clone(self)),
            flow,
            size,
            took: Duration::ZERO,
        }
    }

    /// Charges `flow` for a turn, and hands it on, or keeps it for later if nobody waits.
    fn hand_on(self: &Arc<Self>, flow: FlowNumber, size: usize, took: Duration) {
        let now = Instant::now();
        let mut state = self.state.lock();
        state.charge(flow, took);
        state.free += size;
        while let Some((flow, size, next)) = state.next(now) {
            let wait = now.saturating_duration_since(next.since);
            let limit = match size {
                SHORT_TURNS => self.limit(&mut state, wait, now).0,
                _ => self.burst,
            };
            let is_late = next.stage == Stage::New && wait > limit;
            if is_late {
                self.refuse(&mut state, now);
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
        state.look(now);
    }
}

impl Flow {
    /// The wait of a call that comes now, by that of the last one that has begun.
    fn wait(&self) -> Duration {
        match self.waiting.is_empty() {
            true => Duration::ZERO,
            false => self.last_wait,
        }
    }

    /// True if none of its calls waits.
    fn is_idle(&self) -> bool {
        self.waiting.is_empty() && self.behind.is_empty()
    }

    /// The stage of the call that has the next turn.
    fn next_stage(&self) -> Option<Stage> {
        let first = self.waiting.front().map(|waiting| waiting.stage);
        match first {
            Some(Stage::GoesOn) => first,
            Some(_) if self.behind.is_empty() || !self.behind_is_due => first,
            _ => self.behind.front().map(|waiting| waiting.stage),
        }
    }

    fn pop(&mut self, stage: Stage) -> Option<Waiting> {
        match stage {
            Stage::GoesOn => self.waiting.pop_front(),
            Stage::New => {
                self.behind_is_due = true;
                self.waiting.pop_front()
            }
            Stage::GoesBehind => {
                self.behind_is_due = false;
                self.behind.pop_front()
            }
        }
    }
}

impl State {
    /// Notes whether a call waits that has not begun.
    fn look(&mut self, now: Instant) {
        if self.new == 0 {
            self.was_empty = now;
        }
    }

    /// A turn of `flow` begins, for which nobody waited.
    fn begin(&mut self, flow: FlowNumber) {
        let flow = self.flows.entry(flow).or_default();
        flow.used_ns = flow.used_ns.max(self.clock_ns);
        self.clock_ns = flow.used_ns;
    }

    fn enqueue(
        &mut self,
        number: FlowNumber,
        stage: Stage,
        since: Instant,
    ) -> oneshot::Receiver<Granted> {
        let flow = self.flows.entry(number).or_default();
        if flow.is_idle() {
            flow.used_ns = flow.used_ns.max(self.clock_ns);
            self.order.insert((flow.used_ns, number));
        }
        let (granted, receiver) = oneshot::channel();
        let waiting = Waiting {
            since,
            stage,
            granted,
        };
        match stage {
            Stage::GoesOn => flow.waiting.push_front(waiting),
            Stage::New => {
                self.new += 1;
                flow.waiting.push_back(waiting);
            }
            Stage::GoesBehind => flow.behind.push_back(waiting),
        }
        receiver
    }

    /// Takes the next call out of the queue if there is a turn for it.
    fn next(&mut self, now: Instant) -> Option<(FlowNumber, usize, Waiting)> {
        let &(used_ns, number) = self.order.first()?;
        let stage = self.flows.get(&number)?.next_stage()?;
        let size = self.size(number, stage);
        self.free = self.free.checked_sub(size)?;
        let flow = self.flows.get_mut(&number)?;
        let next = flow.pop(stage)?;
        if stage == Stage::New {
            self.new -= 1;
            flow.last_wait = now.saturating_duration_since(next.since);
        }
        if flow.is_idle() {
            self.order.remove(&(used_ns, number));
        }
        self.clock_ns = used_ns;
        Some((number, size, next))
    }

    /// The short turns that a turn of this flow takes.
    fn size(&self, number: FlowNumber, stage: Stage) -> usize {
        let mean_ns = self.flows.get(&number).and_then(|flow| flow.mean_ns);
        match mean_ns {
            Some(mean_ns) if stage == Stage::New && mean_ns <= MAX_SHORT_NS => 1,
            _ => SHORT_TURNS,
        }
    }

    fn charge(&mut self, number: FlowNumber, took: Duration) {
        // A closed flow pays nothing.
        let Some(flow) = self.flows.get_mut(&number) else {
            return;
        };
        let (before, took_ns) = (flow.used_ns, took.as_nanos() as u64);
        flow.used_ns = before.saturating_add(took_ns);
        let mean_ns = flow.mean_ns.unwrap_or(took_ns);
        flow.mean_ns = Some(mean_ns - mean_ns / MEAN_TURNS + took_ns / MEAN_TURNS);
        if self.order.remove(&(before, number)) {
            self.order.insert((flow.used_ns, number));
        }
    }
}

impl Turn {
    /// Ends the turn after `took` of work.
    pub(super) fn end(mut self, took: Duration) {
        self.took = took;
    }
}

impl Drop for Turn {
    fn drop(&mut self) {
        if let Some(turns) = self.turns.take() {
            turns.hand_on(self.flow, self.size, self.took);
        }
    }
}

#[cfg(test)]
mod tests;
