//! The flows and their waiting calls, in the order of their turns.

use std::{
    collections::{BTreeMap, HashMap, VecDeque},
    time::{Duration, Instant},
};

use tokio::sync::oneshot;

use super::{FlowNumber, Granted, trend::Trend};

/// The most short turns at a time for each thread.
pub(super) const SHORT_TURNS: usize = 128;

/// A flow whose turns take longer on average has long turns.
pub(in crate::admission) const MAX_SHORT_NS: u64 = 50_000;

/// A flow whose turns take longer on average has calls of many turns.
const MAX_BRIEF_NS: u64 = 200_000;

/// Flows of few turns may have used this much more than those of many, and go before them: otherwise one that asks now
/// and then would wait for all that have used as much.
const HEAD_START_NS: u64 = 100_000;

/// The mean of a flow's turns covers about this many of them.
const MEAN_TURNS: u64 = 8;

#[derive(Debug)]
pub(super) struct State {
    /// The free short turns. A long one takes [`SHORT_TURNS`] of them.
    pub(super) free: usize,
    pub(super) flows: HashMap<FlowNumber, Flow>,
    pub(super) order: Order,
    /// The greatest `used_ns` at which a turn began.
    pub(super) clock_ns: u64,
    /// The greatest `used_ns` of a flow of many turns. One that was idle begins there, so that those which use the same
    /// are served as their calls come: otherwise the second call of one would wait for a call of each other.
    pub(super) many_ns: u64,
    /// The waiting calls that have not begun.
    pub(super) new: usize,
    /// The last time that there were none, or only those of one flow.
    pub(super) was_empty: Instant,
    pub(super) trend: Trend,
    /// The queue stands until then.
    pub(super) stands_until: Option<Instant>,
    /// The last flow with a late call, and when; then when another one before it had one.
    pub(super) late: Option<(FlowNumber, Instant)>,
    pub(super) others_late: Option<Instant>,
    pub(super) next_flow: FlowNumber,
    /// The calls that were refused.
    pub(super) refused: u64,
}

/// The flows with waiting calls, in the order of their turns.
#[derive(Debug, Default)]
pub(super) struct Order {
    flows: BTreeMap<Place, FlowNumber>,
    /// The places that were given so far.
    places: u64,
    /// The flows of few turns.
    brief: usize,
}

/// The place of a flow in the order: its `used_ns` without its head start, whether its calls take many turns, and how many
/// places were given before.
pub(super) type Place = (u64, bool, u64);

#[derive(Debug, Default)]
pub(super) struct Flow {
    /// True if its calls are not refused for their wait.
    is_patient: bool,
    /// The time that its turns have taken, and what others took while it was idle.
    pub(super) used_ns: u64,
    /// Its place in the order, if a call waits.
    pub(super) place: Option<Place>,
    /// The mean time of its turns; None before the first.
    pub(super) mean_ns: Option<u64>,
    /// The wait of the last of its calls that has begun.
    pub(super) last_wait: Duration,
    /// The begin of the time in which some call of it always waited that had not begun.
    since: Option<Instant>,
    /// Its own queue stands until then. Its late calls refuse those of other flows only while the queue of all stands.
    stands_until: Option<Instant>,
    /// Those that have not begun, after one that goes on.
    pub(super) waiting: VecDeque<Waiter>,
    /// Those that have computed for long or gave a short turn back, requests of streams, and patient calls.
    pub(super) behind: VecDeque<Waiter>,
    /// True if the next turn goes to `behind`: they and the others take turns.
    pub(super) behind_is_due: bool,
}

#[derive(Debug)]
pub(super) struct Waiter {
    pub(super) since: Instant,
    pub(super) stage: Stage,
    pub(super) granted: oneshot::Sender<Granted>,
}

/// How far a call has come.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::admission) enum Stage {
    /// It has not begun, and can be refused.
    New,
    /// It has computed for less than [`super::MAX_WHOLE`], and keeps its turn if all flows that wait are of many turns.
    Begun,
    /// It goes on before the other calls of its flow.
    Resumed,
    /// It has computed for long, gave a short turn back, or is a request of a stream: it goes after the others of its flow,
    /// and is not refused.
    Demoted,
}

impl Flow {
    /// The wait of a call that comes now, by that of the last one that has begun.
    pub(super) fn wait(&self) -> Duration {
        match self.waiting.is_empty() {
            true => Duration::ZERO,
            false => self.last_wait,
        }
    }

    /// True if its turns are known to take longer than this.
    fn takes_longer(&self, limit_ns: u64) -> bool {
        self.mean_ns.is_some_and(|mean_ns| mean_ns > limit_ns)
    }

    fn is_of_many(&self) -> bool {
        self.takes_longer(MAX_BRIEF_NS)
    }

    /// True if none of its calls waits.
    pub(super) fn is_idle(&self) -> bool {
        self.waiting.is_empty() && self.behind.is_empty()
    }

    /// The stage of the call that has the next turn.
    pub(super) fn next_stage(&self) -> Option<Stage> {
        let first = self.waiting.front().map(|waiting| waiting.stage);
        match first {
            Some(Stage::Begun | Stage::Resumed) => first,
            Some(_) if self.behind.is_empty() => first,
            Some(_) if !self.behind_is_due => first,
            _ => self.behind.front().map(|waiting| waiting.stage),
        }
    }

    pub(super) fn pop(&mut self, stage: Stage) -> Option<Waiter> {
        match stage {
            Stage::Begun | Stage::Resumed => self.waiting.pop_front(),
            Stage::New => {
                self.behind_is_due = true;
                self.waiting.pop_front()
            }
            Stage::Demoted => {
                self.behind_is_due = false;
                self.behind.pop_front()
            }
        }
    }
}

impl Order {
    pub(super) fn is_empty(&self) -> bool {
        self.flows.is_empty()
    }

    /// True if a flow of few turns waits.
    pub(super) fn has_brief(&self) -> bool {
        self.brief > 0
    }

    /// Gives `flow` its place, behind the others that have used as much.
    fn insert(&mut self, number: FlowNumber, flow: &mut Flow) {
        let is_of_many = flow.is_of_many();
        let head_start_ns = if is_of_many { 0 } else { HEAD_START_NS };
        let place = (
            flow.used_ns.saturating_sub(head_start_ns),
            is_of_many,
            self.places,
        );
        self.places += 1;
        self.brief += usize::from(!is_of_many);
        self.flows.insert(place, number);
        flow.place = Some(place);
    }

    /// Takes `flow` out; false if it was not in.
    pub(super) fn remove(&mut self, flow: &mut Flow) -> bool {
        let Some(place) = flow.place.take() else {
            return false;
        };
        self.brief -= usize::from(!place.1);
        self.flows.remove(&place);
        true
    }
}

impl State {
    pub(super) fn open(&mut self, is_patient: bool) -> FlowNumber {
        let number = self.next_flow;
        self.next_flow += 1;
        let flow = Flow {
            is_patient,
            ..Flow::default()
        };
        self.flows.insert(number, flow);
        number
    }

    pub(super) fn is_patient(&self, number: FlowNumber) -> bool {
        self.flows.get(&number).is_some_and(|flow| flow.is_patient)
    }

    /// Notes the time, if no call waits that has not begun, or only those of this flow.
    pub(super) fn note_empty(&mut self, number: FlowNumber, now: Instant) {
        if self.is_alone(number) {
            self.was_empty = now;
        }
        if self.new == 0 {
            self.trend = Trend::new(now);
        }
    }

    /// True if no call of another flow waits that has not begun. Calls of this flow that go on may hide as many.
    fn is_alone(&self, number: FlowNumber) -> bool {
        self.new <= self.flows.get(&number).map_or(0, |flow| flow.waiting.len())
    }

    /// True if the queue of this flow or that of all stands. Each does once it was not empty for the time of a burst.
    pub(super) fn stands(&mut self, number: FlowNumber, burst: Duration, now: Instant) -> bool {
        let lasts = |since: Instant| now.saturating_duration_since(since) > burst;
        if lasts(self.was_empty) {
            self.stands_until = Some(now + burst);
        }
        let flow = self.flows.entry(number).or_default();
        if flow.since.is_some_and(lasts) {
            flow.stands_until = Some(now + burst);
        }
        self.stands_until.max(flow.stands_until) > Some(now)
    }

    /// Lets the queue of this flow stand if it does already, or no other flow waits and none had a late call for the time of
    /// a burst; that of all otherwise.
    pub(super) fn stand(&mut self, number: FlowNumber, burst: Duration, now: Instant) {
        if let Some((_, at)) = self.late.filter(|(last, _)| *last != number) {
            self.others_late = Some(at);
        }
        self.late = Some((number, now));
        let until = Some(now + burst);
        let is_alone = self.is_alone(number) && self.others_late.map(|at| at + burst) <= Some(now);
        match self.flows.get_mut(&number) {
            Some(flow) if is_alone || flow.stands_until > Some(now) => flow.stands_until = until,
            _ => self.stands_until = until,
        }
    }

    /// Begins a turn of `flow` that did not wait in the queue.
    pub(super) fn begin(&mut self, flow: FlowNumber) {
        let flow = self.flows.entry(flow).or_default();
        flow.used_ns = flow.used_ns.max(self.clock_ns);
        self.clock_ns = flow.used_ns;
    }

    pub(super) fn enqueue(
        &mut self,
        number: FlowNumber,
        stage: Stage,
        since: Instant,
    ) -> oneshot::Receiver<Granted> {
        let flow = self.flows.entry(number).or_default();
        if flow.place.is_none() {
            let begins_ns = match stage {
                Stage::New if flow.is_of_many() => self.clock_ns.max(self.many_ns),
                _ => self.clock_ns,
            };
            flow.used_ns = flow.used_ns.max(begins_ns);
            self.order.insert(number, flow);
        }
        let (granted, receiver) = oneshot::channel();
        let waiting = Waiter {
            since,
            stage,
            granted,
        };
        match stage {
            Stage::Begun | Stage::Resumed => flow.waiting.push_front(waiting),
            Stage::New => {
                self.new += 1;
                flow.since.get_or_insert(since);
                flow.waiting.push_back(waiting);
            }
            Stage::Demoted => flow.behind.push_back(waiting),
        }
        receiver
    }

    /// Takes the next call out of the queue if there is a turn for it.
    pub(super) fn next(&mut self, now: Instant) -> Option<(FlowNumber, usize, Waiter)> {
        let (&(place_ns, ..), &number) = self.order.flows.first_key_value()?;
        let stage = self.flows.get(&number)?.next_stage()?;
        let size = self.size(number, stage);
        self.free = self.free.checked_sub(size)?;
        let flow = self.flows.get_mut(&number)?;
        let next = flow.pop(stage)?;
        if stage == Stage::New {
            self.new -= 1;
            flow.last_wait = now.saturating_duration_since(next.since);
            let is_new = |last: &Waiter| last.stage == Stage::New;
            let more_wait = flow.waiting.back().is_some_and(is_new);
            flow.since = flow.since.filter(|_| more_wait);
        }
        if flow.is_idle() {
            self.order.remove(flow);
        }
        self.clock_ns = self.clock_ns.max(place_ns);
        Some((number, size, next))
    }

    /// True if the turns of this flow are known to be long.
    pub(super) fn are_long(&self, number: FlowNumber) -> bool {
        let flow = self.flows.get(&number);
        flow.is_some_and(|flow| flow.takes_longer(MAX_SHORT_NS))
    }

    /// The short turns that a turn of this flow takes.
    pub(super) fn size(&self, number: FlowNumber, stage: Stage) -> usize {
        let mean_ns = self.flows.get(&number).and_then(|flow| flow.mean_ns);
        match mean_ns {
            Some(mean_ns) if stage == Stage::New && mean_ns <= MAX_SHORT_NS => 1,
            _ => SHORT_TURNS,
        }
    }

    pub(super) fn charge(&mut self, number: FlowNumber, took: Duration) {
        // A closed flow pays nothing, and a turn without work is none of the mean.
        let Some(flow) = self.flows.get_mut(&number).filter(|_| !took.is_zero()) else {
            return;
        };
        let took_ns = took.as_nanos() as u64;
        flow.used_ns = flow.used_ns.saturating_add(took_ns);
        let mean_ns = flow.mean_ns.unwrap_or(took_ns);
        flow.mean_ns = Some(mean_ns - mean_ns / MEAN_TURNS + took_ns / MEAN_TURNS);
        if flow.is_of_many() {
            self.many_ns = self.many_ns.max(flow.used_ns);
        }
        if self.order.remove(flow) {
            self.order.insert(number, flow);
        }
    }
}
