//! The flows and their waiting calls, in the order of their turns.

use std::{
    collections::{BTreeSet, HashMap, VecDeque},
    time::{Duration, Instant},
};

use tokio::sync::oneshot;

use super::{FlowNumber, Granted, trend::Trend};

/// The most short turns at a time for each thread.
pub(super) const SHORT_TURNS: usize = 128;

/// A flow whose turns take longer on average has long turns.
const MAX_SHORT_NS: u64 = 50_000;

/// The mean of a flow's turns covers about this many of them.
const MEAN_TURNS: u64 = 8;

#[derive(Debug)]
pub(super) struct State {
    /// The free short turns. A long one takes [`SHORT_TURNS`] of them.
    pub(super) free: usize,
    pub(super) flows: HashMap<FlowNumber, Flow>,
    /// The flows with waiting calls, in the order of their turns: by `used_ns`, then by number.
    pub(super) order: BTreeSet<(u64, FlowNumber)>,
    /// The `used_ns` at which the last turn began.
    pub(super) clock_ns: u64,
    /// The waiting calls that have not begun.
    pub(super) new: usize,
    /// The last time that there were none.
    pub(super) was_empty: Instant,
    pub(super) trend: Trend,
    /// The queue stands until then.
    pub(super) stands_until: Instant,
    pub(super) next_flow: FlowNumber,
    /// The calls that were refused.
    pub(super) refused: u64,
}

#[derive(Debug, Default)]
pub(super) struct Flow {
    /// The time that its turns have taken, and what others took while it was idle.
    pub(super) used_ns: u64,
    /// The mean time of its turns; None before the first.
    pub(super) mean_ns: Option<u64>,
    /// The wait of the last of its calls that has begun.
    pub(super) last_wait: Duration,
    /// Those that have not begun, after one that goes on.
    pub(super) waiting: VecDeque<Waiter>,
    /// Those that have computed for long.
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
    /// It goes on before the other calls of its flow.
    Resumed,
    /// It goes on after them, as one of those that have computed for long.
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

    /// True if none of its calls waits.
    pub(super) fn is_idle(&self) -> bool {
        self.waiting.is_empty() && self.behind.is_empty()
    }

    /// The stage of the call that has the next turn.
    pub(super) fn next_stage(&self) -> Option<Stage> {
        let first = self.waiting.front().map(|waiting| waiting.stage);
        match first {
            Some(Stage::Resumed) => first,
            Some(_) if self.behind.is_empty() => first,
            Some(_) if !self.behind_is_due => first,
            _ => self.behind.front().map(|waiting| waiting.stage),
        }
    }

    pub(super) fn pop(&mut self, stage: Stage) -> Option<Waiter> {
        match stage {
            Stage::Resumed => self.waiting.pop_front(),
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

impl State {
    /// Notes the time, if no call waits that has not begun.
    pub(super) fn note_empty(&mut self, now: Instant) {
        if self.new == 0 {
            self.was_empty = now;
            self.trend = Trend::new(now);
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
        if flow.is_idle() {
            flow.used_ns = flow.used_ns.max(self.clock_ns);
            self.order.insert((flow.used_ns, number));
        }
        let (granted, receiver) = oneshot::channel();
        let waiting = Waiter {
            since,
            stage,
            granted,
        };
        match stage {
            Stage::Resumed => flow.waiting.push_front(waiting),
            Stage::New => {
                self.new += 1;
                flow.waiting.push_back(waiting);
            }
            Stage::Demoted => flow.behind.push_back(waiting),
        }
        receiver
    }

    /// Takes the next call out of the queue if there is a turn for it.
    pub(super) fn next(&mut self, now: Instant) -> Option<(FlowNumber, usize, Waiter)> {
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

    /// True if the turns of this flow are known to be long.
    pub(super) fn are_long(&self, number: FlowNumber) -> bool {
        self.mean_ns(number)
            .is_some_and(|mean_ns| mean_ns > MAX_SHORT_NS)
    }

    fn mean_ns(&self, number: FlowNumber) -> Option<u64> {
        self.flows.get(&number)?.mean_ns
    }

    /// The short turns that a turn of this flow takes.
    pub(super) fn size(&self, number: FlowNumber, stage: Stage) -> usize {
        match self.mean_ns(number) {
            Some(mean_ns) if stage == Stage::New && mean_ns <= MAX_SHORT_NS => 1,
            _ => SHORT_TURNS,
        }
    }

    pub(super) fn charge(&mut self, number: FlowNumber, took: Duration) {
        // A closed flow pays nothing, and a turn without work is none of the mean.
        let Some(flow) = self.flows.get_mut(&number).filter(|_| !took.is_zero()) else {
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
