//! Turns: few calls compute at a time, and the others wait in an order of our own.
//!
//! Without it, all admitted calls would share the threads alike: under overload each of them is late, and the queue
//! stands where nobody measures it. A call takes a turn for each slice of its work and gives it up whenever it waits.
//!
//! - *Fair:* the flow that has computed least goes first (start-time fair queueing). A flow that was idle gets no credit
//!   for that. P. Goyal, H. M. Vin, H. Cheng, *Start-time Fair Queuing*, SIGCOMM 1996.
//! - *First come, first served* within a flow: a call that has begun goes before those that have not.
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
    /// The last time that nobody waited.
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
    waiting: VecDeque<Waiting>,
}

#[derive(Debug)]
struct Waiting {
    since: Instant,
    /// True for a call that has not begun.
    is_first: bool,
    granted: oneshot::Sender<Granted>,
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
pub(super) enum Asked {
    /// There is a turn now.
    Granted(Turn),
    /// There will be one.
    Waits(oneshot::Receiver<Granted>),
}

impl Turns {
    /// The turns on so many threads.
    pub(super) fn new(threads: usize, target: Duration, burst: Duration) -> Arc<Self> {
        Arc::new(Self {
            state: Mutex::new(State {
                free: threads.max(1).saturating_mul(SHORT_TURNS),
                flows: HashMap::new(),
                order: BTreeSet::new(),
                clock_ns: 0,
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
        }
    }

    /// Asks for a turn for a call of `flow`; `is_first` if it has not begun. Its connection has more to read for `behind`.
    pub(super) fn ask(
        self: &Arc<Self>,
        flow: FlowNumber,
        is_first: bool,
        behind: Duration,
        now: Instant,
    ) -> Result<Asked, Overloaded> {
        let mut state = self.state.lock();
        let size = state.size(flow, is_first);
        let is_free = state.order.is_empty() && state.free >= size;
        if is_free {
            state.was_empty = now;
        }
        if is_first && size == SHORT_TURNS {
            // Another call of a flow whose calls wait for long would wait in vain.
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
            return Ok(Asked::Granted(self.turn(flow, size)));
        }
        Ok(Asked::Waits(state.enqueue(flow, is_first, now)))
    }

    /// Charges the flow of `turn` for work that goes on. The turn is handed on if others wait.
    pub(super) fn give_way(self: &Arc<Self>, mut turn: Turn, took: Duration) -> Asked {
        let mut state = self.state.lock();
        state.charge(turn.flow, took);
        // A turn that goes on is a long one.
        let more = SHORT_TURNS - turn.size;
        if state.order.is_empty() && state.free >= more {
            state.free -= more;
            turn.size = SHORT_TURNS;
            return Asked::Granted(turn);
        }
        let granted = state.enqueue(turn.flow, false, Instant::now());
        drop(state);
        turn.took = Duration::ZERO;
        Asked::Waits(granted)
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
            let is_late = next.is_first && wait > limit;
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
        if state.order.is_empty() {
            state.was_empty = now;
        }
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
}

impl State {
    /// A turn of `flow` begins, for which nobody waited.
    fn begin(&mut self, flow: FlowNumber) {
        let flow = self.flows.entry(flow).or_default();
        flow.used_ns = flow.used_ns.max(self.clock_ns);
        self.clock_ns = flow.used_ns;
    }

    fn enqueue(
        &mut self,
        number: FlowNumber,
        is_first: bool,
        since: Instant,
    ) -> oneshot::Receiver<Granted> {
        let flow = self.flows.entry(number).or_default();
        if flow.waiting.is_empty() {
            flow.used_ns = flow.used_ns.max(self.clock_ns);
            self.order.insert((flow.used_ns, number));
        }
        let (granted, receiver) = oneshot::channel();
        let waiting = Waiting {
            since,
            is_first,
            granted,
        };
        match is_first {
            true => flow.waiting.push_back(waiting),
            false => flow.waiting.push_front(waiting),
        }
        receiver
    }

    /// Takes the next call out of the queue if there is a turn for it.
    fn next(&mut self, now: Instant) -> Option<(FlowNumber, usize, Waiting)> {
        let &(used_ns, number) = self.order.first()?;
        let is_first = self.flows.get(&number)?.waiting.front()?.is_first;
        let size = self.size(number, is_first);
        self.free = self.free.checked_sub(size)?;
        let flow = self.flows.get_mut(&number)?;
        let next = flow.waiting.pop_front()?;
        if is_first {
            flow.last_wait = now.saturating_duration_since(next.since);
        }
        if flow.waiting.is_empty() {
            self.order.remove(&(used_ns, number));
        }
        self.clock_ns = used_ns;
        Some((number, size, next))
    }

    /// The short turns that a turn of this flow takes.
    fn size(&self, number: FlowNumber, is_first: bool) -> usize {
        let mean_ns = self.flows.get(&number).and_then(|flow| flow.mean_ns);
        match mean_ns {
            Some(mean_ns) if is_first && mean_ns <= MAX_SHORT_NS => 1,
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
mod tests {
    use super::*;

    const MS: Duration = Duration::from_millis(1);
    const TARGET: Duration = Duration::from_millis(100);
    const BURST: Duration = Duration::from_secs(3600);

    /// A turn at once.
    fn take(turns: &Arc<Turns>, flow: FlowNumber) -> Turn {
        match turns
            .ask(flow, true, Duration::ZERO, Instant::now())
            .unwrap()
        {
            Asked::Granted(turn) => turn,
            other => panic!("{other:?}"),
        }
    }

    /// A call that waits since some time ago.
    fn wait(
        turns: &Arc<Turns>,
        flow: FlowNumber,
        is_first: bool,
        ago: Duration,
    ) -> oneshot::Receiver<Granted> {
        match turns
            .ask(flow, is_first, Duration::ZERO, Instant::now() - ago)
            .unwrap()
        {
            Asked::Waits(granted) => granted,
            other => panic!("{other:?}"),
        }
    }

    /// Ends `turn` after `took`; returns the number of the waiting call that has the next turn, and the turn.
    fn next(
        turn: Turn,
        took: Duration,
        waiting: &mut [oneshot::Receiver<Granted>],
    ) -> Option<(usize, Turn)> {
        turn.end(took);
        let granted = |granted: &mut oneshot::Receiver<Granted>| granted.try_recv().ok();
        waiting
            .iter_mut()
            .enumerate()
            .find_map(|(number, waits)| Some((number, granted(waits)?.unwrap())))
    }

    #[test]
    fn the_flow_that_has_computed_least_goes_first() {
        let turns = Turns::new(1, TARGET, BURST);
        let (heavy, light) = (turns.open(), turns.open());
        // The time before anybody waited counts for nobody.
        take(&turns, heavy).end(1000 * MS);
        let turn = take(&turns, heavy);
        let mut waiting = vec![
            wait(&turns, heavy, true, MS),
            wait(&turns, heavy, true, MS),
            wait(&turns, light, true, MS),
            wait(&turns, light, true, MS),
        ];
        let (first, turn) = next(turn, 3 * MS, &mut waiting).unwrap();
        let (second, turn) = next(turn, MS, &mut waiting).unwrap();
        let (third, turn) = next(turn, 3 * MS, &mut waiting).unwrap();
        let (fourth, turn) = next(turn, MS, &mut waiting).unwrap();
        assert_eq!([first, second, third, fourth], [2, 3, 0, 1]);
        assert!(next(turn, MS, &mut waiting).is_none());
        // An idle flow has saved nothing: both are even again.
        let turn = take(&turns, heavy);
        turn.end(5 * MS);
        let turn = take(&turns, light);
        let mut waiting = vec![wait(&turns, light, true, MS), wait(&turns, heavy, true, MS)];
        let (first, _turn) = next(turn, 10 * MS, &mut waiting).unwrap();
        assert_eq!(first, 1);
    }

    #[test]
    fn a_call_that_has_begun_goes_before_others_of_its_flow() {
        let turns = Turns::new(1, TARGET, BURST);
        let flow = turns.open();
        let turn = take(&turns, flow);
        let mut waiting = vec![wait(&turns, flow, true, MS), wait(&turns, flow, false, MS)];
        let (first, _turn) = next(turn, MS, &mut waiting).unwrap();
        assert_eq!(first, 1);
    }

    #[test]
    fn work_that_goes_on_gives_way_only_if_others_wait() {
        let turns = Turns::new(1, TARGET, BURST);
        let (heavy, light) = (turns.open(), turns.open());
        let turn = match turns.give_way(take(&turns, heavy), 5 * MS) {
            Asked::Granted(turn) => turn,
            waits => panic!("{waits:?}"),
        };
        let mut first = wait(&turns, light, true, MS);
        let mut going_on = match turns.give_way(turn, 5 * MS) {
            Asked::Waits(waits) => waits,
            granted => panic!("{granted:?}"),
        };
        assert!(going_on.try_recv().is_err());
        first.try_recv().unwrap().unwrap().end(MS);
        going_on.try_recv().unwrap().unwrap().end(MS);
    }

    #[test]
    fn who_has_left_is_passed_over_and_returns_the_turn() {
        let turns = Turns::new(1, TARGET, BURST);
        let flow = turns.open();
        let turn = take(&turns, flow);
        drop(wait(&turns, flow, true, MS));
        let granted = wait(&turns, flow, true, MS);
        let mut last = vec![wait(&turns, flow, true, MS)];
        turn.end(MS);
        // It has its turn, and does not use it.
        drop(granted);
        let turn = last.remove(0).try_recv().unwrap().unwrap();
        assert!(next(turn, MS, &mut []).is_none());
        take(&turns, flow).end(MS);
    }

    #[test]
    fn a_call_of_a_burst_waits() {
        let turns = Turns::new(1, TARGET, BURST);
        let flow = turns.open();
        let turn = take(&turns, flow);
        let mut late = wait(&turns, flow, true, 2 * TARGET);
        turn.end(MS);
        late.try_recv().unwrap().unwrap().end(MS);
        assert_eq!(turns.refused(), 0);
    }

    #[test]
    fn a_late_call_of_a_standing_queue_is_refused_and_so_are_those_that_would_be_late() {
        let turns = Turns::new(1, TARGET, MS);
        let flow = turns.open();
        let turn = take(&turns, flow);
        let mut begun = wait(&turns, flow, false, 2 * TARGET);
        let mut late = wait(&turns, flow, true, 2 * TARGET);
        let mut in_time = wait(&turns, flow, true, TARGET * 3 / 4);
        let mut last = wait(&turns, flow, true, MS);
        turn.end(MS);
        begun.try_recv().unwrap().unwrap().end(MS);
        assert_eq!(late.try_recv().unwrap().err(), Some(Overloaded(TARGET)));
        let turn = in_time.try_recv().unwrap().unwrap();
        let other = turns.ask(flow, true, Duration::ZERO, Instant::now());
        assert_eq!(other.err(), Some(Overloaded(TARGET)));
        turn.end(MS);
        last.try_recv().unwrap().unwrap().end(MS);
        assert_eq!(turns.refused(), 2);
    }

    #[test]
    fn a_thread_has_one_long_turn_or_many_short_ones() {
        let turns = Turns::new(1, TARGET, BURST);
        // Turns are long until they are known to be short.
        let (long, short) = (turns.open(), turns.open());
        take(&turns, short).end(MS / 1000);
        let mut held: Vec<Turn> = (0..SHORT_TURNS).map(|_| take(&turns, short)).collect();
        let mut third = wait(&turns, long, true, MS);
        let mut fourth = wait(&turns, short, true, MS);
        let last = held.pop();
        drop(held);
        assert!(third.try_recv().is_err() && fourth.try_recv().is_err());
        drop(last);
        let third = third.try_recv().unwrap().unwrap();
        assert!(fourth.try_recv().is_err());
        third.end(MS);
        fourth.try_recv().unwrap().unwrap().end(MS);
    }

    #[test]
    fn as_many_long_turns_as_threads_and_none_is_lost() {
        let turns = Turns::new(3, TARGET, BURST);
        let flow = turns.open();
        take(&turns, flow).end(MS);
        let held: Vec<Turn> = (0..3).map(|_| take(&turns, flow)).collect();
        let mut waiting: Vec<_> = (0..5).map(|_| wait(&turns, flow, true, MS)).collect();
        assert!(waiting.iter_mut().all(|waits| waits.try_recv().is_err()));
        drop(held);
        let mut granted: Vec<Turn> = waiting
            .iter_mut()
            .filter_map(|waits| waits.try_recv().ok()?.ok())
            .collect();
        assert_eq!(granted.len(), 3);
        turns.close(flow);
        granted.clear();
        let other = turns.open();
        take(&turns, other).end(MS);
        let _all: Vec<Turn> = (0..3).map(|_| take(&turns, other)).collect();
    }
}
