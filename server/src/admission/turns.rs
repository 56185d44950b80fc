//! Turns: as many calls compute at a time as there are threads, and the others wait in an order of our own.
//!
//! Without it, all admitted calls would share the threads alike: under overload each of them is late, and the queue
//! stands where nobody measures it. A call takes a turn for each slice of its work and gives it up whenever it waits.
//!
//! - *Fair:* the flow that has computed least goes first (start-time fair queueing). A flow that was idle gets no credit
//!   for that. P. Goyal, H. M. Vin, H. Cheng, *Start-time Fair Queuing*, SIGCOMM 1996.
//! - *First come, first served* within a flow: a call that has begun goes before those that have not.
//! - *Measured:* a call that has not begun is refused once it has waited for too long: for the time of a burst if the
//!   queue was empty within that time, and otherwise for the target. B. Maurer, *Fail at Scale*, ACM Queue 13(8), 2015,
//!   after CoDel.

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
    /// The time that it waits otherwise; a queue that was not empty for longer stands.
    burst: Duration,
}

#[derive(Debug)]
struct State {
    /// The turns that nobody has. While there are some, nobody waits.
    free: usize,
    flows: HashMap<FlowNumber, Flow>,
    /// The flows with waiting calls, in the order of their turns: by `used_ns`, then by number.
    order: BTreeSet<(u64, FlowNumber)>,
    /// The `used_ns` at which the last turn began.
    clock_ns: u64,
    /// The last time that nobody waited.
    was_empty: Instant,
    next_flow: FlowNumber,
}

#[derive(Debug, Default)]
struct Flow {
    /// The time that its turns have taken, and what others took while it was idle.
    used_ns: u64,
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
    /// As many turns at a time as `threads`.
    pub(super) fn new(threads: usize, target: Duration, burst: Duration) -> Arc<Self> {
        Arc::new(Self {
            state: Mutex::new(State {
                free: threads.max(1),
                flows: HashMap::new(),
                order: BTreeSet::new(),
                clock_ns: 0,
                was_empty: Instant::now(),
                next_flow: 0,
            }),
            target,
            burst,
        })
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

    /// Asks for a turn for a call of `flow`; `is_first` if it has not begun.
    pub(super) fn ask(
        self: &Arc<Self>,
        flow: FlowNumber,
        is_first: bool,
        now: Instant,
    ) -> Result<Asked, Overloaded> {
        let mut state = self.state.lock();
        if state.free > 0 {
            state.free -= 1;
            state.was_empty = now;
            state.begin(flow);
            return Ok(Asked::Granted(self.turn(flow)));
        }
        let limit = self.limit(state.was_empty, now);
        let oldest = state.flows.get(&flow).and_then(|flow| flow.waiting.front());
        if let Some(oldest) = oldest.filter(|oldest| is_first && oldest.is_first)
            && now.saturating_duration_since(oldest.since) > limit
        {
            return Err(Overloaded(self.target));
        }
        Ok(Asked::Waits(state.enqueue(flow, is_first, now)))
    }

    /// Charges the flow of `turn` for work that goes on. The turn is handed on if others wait.
    pub(super) fn give_way(self: &Arc<Self>, mut turn: Turn, took: Duration) -> Asked {
        let mut state = self.state.lock();
        state.charge(turn.flow, took);
        if state.order.is_empty() {
            return Asked::Granted(turn);
        }
        let granted = state.enqueue(turn.flow, false, Instant::now());
        drop(state);
        turn.took = Duration::ZERO;
        Asked::Waits(granted)
    }

    /// The longest wait for a first turn.
    fn limit(&self, was_empty: Instant, now: Instant) -> Duration {
        let stands = now.saturating_duration_since(was_empty) > self.burst;
        if stands { self.target } else { self.burst }
    }

    fn turn(self: &Arc<Self>, flow: FlowNumber) -> Turn {
        Turn {
            turns: Some(Arc::clone(self)),
            flow,
            took: Duration::ZERO,
        }
    }

    /// Charges `flow` for a turn, and hands it on, or keeps it for later if nobody waits.
    fn hand_on(self: &Arc<Self>, flow: FlowNumber, took: Duration) {
        let now = Instant::now();
        let mut state = self.state.lock();
        state.charge(flow, took);
        while let Some((flow, next)) = state.next() {
            let limit = self.limit(state.was_empty, now);
            // A receiver that is dropped here locks the state again.
            drop(state);
            let is_late = now.saturating_duration_since(next.since) > limit;
            let granted = match next.is_first && is_late {
                true => Err(Overloaded(self.target)),
                false => Ok(self.turn(flow)),
            };
            let is_refusal = granted.is_err();
            match next.granted.send(granted) {
                Ok(()) if !is_refusal => return,
                // The caller has left, and its turn goes to the next one.
                Err(Ok(mut turn)) => turn.turns = None,
                Ok(()) | Err(Err(_)) => {}
            }
            state = self.state.lock();
        }
        state.free += 1;
        state.was_empty = now;
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

    /// Takes the next call out of the queue.
    fn next(&mut self) -> Option<(FlowNumber, Waiting)> {
        let &(used_ns, number) = self.order.first()?;
        let flow = self.flows.get_mut(&number)?;
        let next = flow.waiting.pop_front()?;
        if flow.waiting.is_empty() {
            self.order.remove(&(used_ns, number));
        }
        self.clock_ns = used_ns;
        Some((number, next))
    }

    fn charge(&mut self, number: FlowNumber, took: Duration) {
        // A closed flow pays nothing.
        let Some(flow) = self.flows.get_mut(&number) else {
            return;
        };
        let before = flow.used_ns;
        flow.used_ns = before.saturating_add(took.as_nanos() as u64);
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
            turns.hand_on(self.flow, self.took);
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
        match turns.ask(flow, true, Instant::now()).unwrap() {
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
        match turns.ask(flow, is_first, Instant::now() - ago).unwrap() {
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
    fn a_call_of_a_burst_waits_and_one_of_a_standing_queue_is_refused() {
        for (burst, is_refused) in [(BURST, false), (Duration::ZERO, true)] {
            let turns = Turns::new(1, TARGET, burst);
            let flow = turns.open();
            let turn = take(&turns, flow);
            let mut begun = wait(&turns, flow, false, 2 * TARGET);
            let mut late = wait(&turns, flow, true, 2 * TARGET);
            let mut early = wait(&turns, flow, true, MS);
            turn.end(MS);
            let turn = begun.try_recv().unwrap().unwrap();
            // The flow's oldest call is late, so another need not wait in vain.
            let asked = turns.ask(flow, true, Instant::now());
            assert_eq!(asked.err(), is_refused.then_some(Overloaded(TARGET)));
            turn.end(MS);
            let turn = late.try_recv().unwrap();
            assert_eq!(turn.is_err(), is_refused);
            drop(turn);
            early.try_recv().unwrap().unwrap().end(MS);
        }
    }

    #[test]
    fn as_many_turns_as_threads_and_none_is_lost() {
        let turns = Turns::new(3, TARGET, BURST);
        let flow = turns.open();
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
        let _all: Vec<Turn> = (0..3).map(|_| take(&turns, other)).collect();
    }
}
