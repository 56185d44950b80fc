//! A store with one order, for clients whose operations overlap, and its faults.

use std::collections::{BTreeMap, BTreeSet};

use proptest::prelude::*;
use wayfold_tests::history::{Answer, Call, NEVER, Operation, Point, ReadPoints, Step};

/// The nanoseconds between two moments at which operations take effect.
const BEAT: u64 = 100;
/// The client that follows the store.
const FOLLOWER: u64 = 1000;

/// A request of a client to the store.
#[derive(Clone, Debug)]
pub(crate) enum Kind {
    /// A point with an id of the store's.
    Put,
    /// The removal of a point that is or was stored.
    Remove(u64),
    /// A tag for such a point.
    SetTag(u64, u64),
    /// The same if the point has not changed after a revision up to the one that the client knows.
    SetTagIf(u64, u64, u64),
    /// A read of all points.
    Latest,
    /// A read of all points as of a revision that the client has not passed.
    Plain(u64),
}

/// An operation to come.
#[derive(Clone, Debug)]
pub(crate) struct Request {
    kind: Kind,
    /// The nanoseconds from the invocation to the effect, and from the effect to the answer.
    before: u64,
    after: u64,
    /// The answer is lost; the flag says whether the effect is too.
    unknown: Option<bool>,
}

pub(crate) fn request() -> impl Strategy<Value = Request> {
    let kind = prop_oneof![
        4 => Just(Kind::Put),
        2 => any::<u64>().prop_map(Kind::Remove),
        1 => (any::<u64>(), any::<u64>()).prop_map(|(id, tag)| Kind::SetTag(id, tag)),
        3 => (any::<u64>(), any::<u64>(), 0..16_u64)
            .prop_map(|(id, tag, age)| Kind::SetTagIf(id, tag, age)),
        2 => Just(Kind::Latest),
        2 => any::<u64>().prop_map(Kind::Plain),
    ];
    let unknown = prop_oneof![6 => Just(None), 1 => any::<bool>().prop_map(Some)];
    let times = (0..5 * BEAT, 0..5 * BEAT);
    (kind, times, unknown).prop_map(|(kind, (before, after), unknown)| Request {
        kind,
        before,
        after,
        unknown,
    })
}

/// A fault of the first operation that can have it, from one on.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Fault {
    /// An acknowledged point is not stored.
    Forget,
    /// An acknowledged point is stored twice.
    Double,
    /// A read of the latest is answered from before an answer that had returned.
    Past,
    /// A compare-and-set takes effect though its point has changed.
    Overwrite,
}

type Points = BTreeMap<u64, Point>;

#[derive(Default)]
pub(crate) struct Store {
    points: Points,
    revision: u64,
    next_id: u64,
    next_payload: u64,
    /// The contents by revision.
    past: BTreeMap<u64, Points>,
    /// The revisions at which points changed last.
    changed: BTreeMap<u64, u64>,
    /// True if a client follows all records.
    is_followed: bool,
    /// The end of each client's last operation, and the revision that it knows.
    clients: Vec<(u64, u64)>,
    /// The points of a fault; clients do not remove them, which would hide it.
    faulty: Vec<u64>,
    /// True if the fault could be had.
    pub(crate) has_failed: bool,
}

impl Store {
    /// A store whose records a client may follow.
    pub(crate) fn new(is_followed: bool) -> Self {
        Self {
            is_followed,
            ..Self::default()
        }
    }

    /// Answers requests in their order, and a read of all points. Returns the history and the number of mutations without
    /// an answer.
    pub(crate) fn serve(
        &mut self,
        requests: &[Request],
        fault: Option<(usize, Fault)>,
    ) -> (Vec<Operation>, u64) {
        let mut history = Vec::new();
        let mut unknown = 0;
        self.past.insert(0, Points::new());
        for (at, request) in requests.iter().enumerate() {
            let now = (at as u64 + 10) * BEAT;
            let fault = fault.filter(|(first, _)| *first <= at && !self.has_failed);
            let fault = fault.map(|(_, it)| it);
            let before = self.revision;
            let operation = self.answer(request, now, fault, &history);
            unknown += u64::from(operation.returned == NEVER);
            history.push(operation);
            if self.is_followed && self.revision > before {
                history.push(self.record(now));
            }
        }
        let last = Request {
            kind: Kind::Latest,
            before: 0,
            after: 0,
            unknown: None,
        };
        let now = (requests.len() as u64 + 20) * BEAT;
        history.push(self.answer(&last, now, None, &[]));
        (history, unknown)
    }

    fn answer(
        &mut self,
        request: &Request,
        now: u64,
        fault: Option<Fault>,
        history: &[Operation],
    ) -> Operation {
        let client = self.client(now);
        let (free, known) = self.clients[client];
        let invoked = (now - request.before).max(free + 1);
        let mut returned = now + request.after;
        let mut answer_is_lost = false;
        let call = match &request.kind {
            Kind::Latest => {
                self.change();
                let mut revision = self.revision;
                if let Some(Fault::Past) = fault {
                    let before = history.iter().filter(|it| it.returned < invoked);
                    let newest = before.filter_map(|it| answered_revision(&it.call)).max();
                    if let Some(past) = newest.and_then(|it| it.checked_sub(1)) {
                        (revision, self.has_failed) = (past, true);
                    }
                }
                self.read(true, revision)
            }
            Kind::Plain(at) => {
                let revision = known + at % (self.revision - known + 1);
                self.read(false, revision)
            }
            mutation => {
                answer_is_lost = request.unknown.is_some();
                let has_effect = request.unknown != Some(false);
                let step = self.step(mutation, known, answer_is_lost);
                self.mutate(step, has_effect, answer_is_lost, fault)
            }
        };
        let revision = answered_revision(&call).unwrap_or(known);
        if answer_is_lost {
            returned = NEVER;
        }
        self.clients[client] = (returned, known.max(revision));
        Operation {
            client: client as u64,
            invoked,
            returned,
            call,
        }
    }

    /// A client without an operation at this time.
    fn client(&mut self, now: u64) -> usize {
        let free = self.clients.iter().position(|(until, _)| *until < now - 1);
        free.unwrap_or_else(|| {
            self.clients.push((0, 0));
            self.clients.len() - 1
        })
    }

    /// Makes a revision of the stored points.
    fn change(&mut self) {
        self.revision += 1;
        self.past.insert(self.revision, self.points.clone());
    }

    fn read(&self, latest: bool, revision: u64) -> Call {
        Call::Read {
            latest,
            revision,
            seen: ReadPoints::All(self.past[&revision].clone()),
        }
    }

    /// The record of the newest revision.
    fn record(&self, now: u64) -> Operation {
        let (before, after) = (&self.past[&(self.revision - 1)], &self.past[&self.revision]);
        let stored = after.iter();
        let stored = stored.filter(|&(id, point)| before.get(id) != Some(point));
        let removed = before.keys().filter(|id| !after.contains_key(*id));
        let call = Call::Record {
            revision: self.revision,
            stored: stored.map(|(id, point)| (*id, *point)).collect(),
            removed: removed.copied().collect::<BTreeSet<u64>>(),
        };
        Operation {
            client: FOLLOWER,
            invoked: now,
            returned: now + 1,
            call,
        }
    }

    /// The step of a mutation of a client that knows a revision.
    fn step(&mut self, mutation: &Kind, known: u64, answer_is_lost: bool) -> Step {
        let ids: Vec<u64> = (0..self.next_id)
            .filter(|id| !self.faulty.contains(id))
            .collect();
        let choose = |at: u64| match ids.len() as u64 {
            0 => u64::MAX,
            count => ids[(at % count) as usize],
        };
        match *mutation {
            Kind::Remove(at) => Step::Remove(choose(at)),
            Kind::SetTag(at, tag) => Step::SetTag(choose(at), tag),
            Kind::SetTagIf(at, tag, age) => Step::SetTagIf {
                id: choose(at),
                tag,
                if_revision: known.saturating_sub(age),
            },
            Kind::Put | Kind::Latest | Kind::Plain(_) => {
                self.next_payload += 1;
                Step::Put {
                    id: (!answer_is_lost).then_some(self.next_id),
                    tag: 0,
                    payload: self.next_payload,
                }
            }
        }
    }

    fn mutate(
        &mut self,
        step: Step,
        has_effect: bool,
        answer_is_lost: bool,
        fault: Option<Fault>,
    ) -> Call {
        let fault = fault.filter(|_| !answer_is_lost);
        let mut is_refused = false;
        if let Step::SetTagIf {
            id,
            tag,
            if_revision,
        } = step
            && let Some(point) = self.points.get(&id)
        {
            is_refused = self.changed[&id] > if_revision;
            if is_refused && matches!(fault, Some(Fault::Overwrite)) && point.tag != tag {
                (is_refused, self.has_failed) = (false, true);
            }
            if is_refused && !answer_is_lost {
                return Call::Conflict { id, if_revision };
            }
        }
        let changed = has_effect && !is_refused && self.apply(step, fault);
        let answer = Answer {
            revision: self.revision,
            changed,
        };
        Call::Mutation {
            steps: vec![step],
            answer: (!answer_is_lost).then_some(answer),
        }
    }

    /// Returns false if it finds nothing to change.
    fn apply(&mut self, step: Step, fault: Option<Fault>) -> bool {
        let changed = match step {
            Step::Put { tag, payload, .. } => {
                let point = Point {
                    tag,
                    payload,
                    state: payload,
                    stored: self.revision + 1,
                };
                let times = match fault {
                    Some(Fault::Forget) => 0,
                    Some(Fault::Double) => 2,
                    _ => 1,
                };
                for id in self.next_id..self.next_id + times {
                    self.points.insert(id, point);
                    self.changed.insert(id, point.stored);
                }
                let next_id = self.next_id + times.max(1);
                if times != 1 {
                    self.has_failed = true;
                    self.faulty = (self.next_id..next_id).collect();
                }
                self.next_id = next_id;
                true
            }
            Step::Remove(id) => self.points.remove(&id).is_some(),
            Step::SetTag(id, tag) | Step::SetTagIf { id, tag, .. } => {
                match self.points.get_mut(&id) {
                    Some(point) if point.tag != tag => {
                        point.tag = tag;
                        self.changed.insert(id, self.revision + 1);
                        true
                    }
                    _ => false,
                }
            }
        };
        if changed {
            self.change();
        }
        changed
    }
}

/// The revision of an answer.
fn answered_revision(call: &Call) -> Option<u64> {
    match call {
        Call::Read { revision, .. } | Call::Record { revision, .. } => Some(*revision),
        Call::Mutation { answer, .. } => answer.map(|it| it.revision),
        Call::Conflict { .. } => None,
    }
}
