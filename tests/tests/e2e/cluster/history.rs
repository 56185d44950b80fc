//! The answers to clients as the operations that the checker of histories knows.

use std::{collections::BTreeMap, time::Instant};

use prost::bytes::Bytes;
use wayfold_proto::v1::{GetResponse, Points, StepKind};
use wayfold_tests::{
    Content, bits,
    history::{
        Answer, Call, NEVER, Operation, Point, ReadPoints, Step, digest,
        names::{NameCall, NameOperation},
    },
    ledger::Entry,
    number,
};

use crate::clients::{Acknowledged, Conflict};

/// The clock of a history.
#[derive(Clone, Copy)]
pub(super) struct History {
    start: Instant,
}

impl History {
    pub(super) fn new() -> Self {
        Self {
            start: Instant::now(),
        }
    }

    pub(super) fn operation(
        &self,
        client: u64,
        invoked: Instant,
        returned: Instant,
        call: Call,
    ) -> Operation {
        Operation {
            client,
            invoked: self.nanoseconds(invoked),
            returned: self.nanoseconds(returned),
            call,
        }
    }

    fn nanoseconds(&self, time: Instant) -> u64 {
        let nanoseconds = time.saturating_duration_since(self.start).as_nanos();
        u64::try_from(nanoseconds).expect("less than centuries")
    }

    /// An acknowledged mutation.
    pub(super) fn mutation(&self, client: u64, acknowledged: &Acknowledged) -> Operation {
        let Acknowledged {
            entry,
            invoked,
            returned,
        } = acknowledged;
        let answer = Answer {
            revision: entry.revision(),
            changed: entry.changed(),
        };
        let call = Call::Mutation {
            steps: steps(entry),
            answer: Some(answer),
        };
        self.operation(client, *invoked, *returned, call)
    }

    /// A mutation of unknown outcome.
    pub(super) fn unknown(&self, client: u64, entry: &Entry, invoked: Instant) -> Operation {
        let call = Call::Mutation {
            steps: steps(entry),
            answer: None,
        };
        let operation = self.operation(client, invoked, invoked, call);
        Operation {
            returned: NEVER,
            ..operation
        }
    }

    /// A compare-and-set that was refused because its point had changed.
    pub(super) fn conflict(&self, client: u64, conflict: &Conflict) -> Operation {
        let Conflict {
            request,
            invoked,
            returned,
        } = conflict;
        let call = Call::Conflict {
            id: request.ids[0],
            if_revision: number(&request.if_revision),
        };
        self.operation(client, *invoked, *returned, call)
    }

    /// A call for an index by its name at a server; none returns if it was not answered.
    pub(super) fn named(
        &self,
        (client, server): (u64, u64),
        invoked: Instant,
        returned: Option<Instant>,
        call: NameCall,
    ) -> NameOperation {
        NameOperation {
            server,
            client,
            invoked: self.nanoseconds(invoked),
            returned: returned.map_or(NEVER, |it| self.nanoseconds(it)),
            call,
        }
    }
}

/// A read of all points.
pub(super) fn scan(latest: bool, content: &Content) -> Call {
    Call::Read {
        latest,
        revision: content.revision,
        seen: ReadPoints::All(content_points(content)),
    }
}

/// The points of an index.
pub(super) fn content_points(content: &Content) -> BTreeMap<u64, Point> {
    let points = content.points.iter().map(|(&id, stored)| {
        let point = Point {
            tag: stored.tag,
            payload: digest(&stored.payload[..]),
            state: digest(&stored.state[..]),
            stored: stored.revision,
        };
        (id, point)
    });
    points.collect()
}

/// A read of some points.
pub(super) fn points(latest: bool, answer: &GetResponse) -> Call {
    let seen = answer.points.as_ref().map(told_points);
    Call::Read {
        latest,
        revision: number(&answer.revision),
        seen: ReadPoints::These(seen.unwrap_or_default()),
    }
}

/// Points of an answer with all columns.
pub(super) fn told_points(points: &Points) -> BTreeMap<u64, Point> {
    let coordinates = points.states.iter().flat_map(|it| &it.coordinates);
    let coordinates: Vec<f64> = coordinates.copied().collect();
    let width = coordinates.len() / points.ids.len().max(1);
    let points = points.ids.iter().enumerate().map(|(at, &id)| {
        let point = Point {
            tag: points.tags[at],
            payload: digest(&points.payloads[at][..]),
            state: digest(&bits(&coordinates[at * width..][..width])[..]),
            stored: points.revisions[at],
        };
        (id, point)
    });
    points.collect()
}

/// The steps of a mutation, with the ids of its answer.
fn steps(entry: &Entry) -> Vec<Step> {
    let put = |id: Option<u64>, tag: u64, payload: &Bytes| Step::Put {
        id,
        tag,
        payload: digest(&payload[..]),
    };
    match entry {
        // It repeats points that are stored: their revisions tell if it stores them again.
        Entry::Insert(request, _) if !request.ids.is_empty() => Vec::new(),
        Entry::Insert(request, response) => {
            // Without an answer there are no ids.
            let ids = response.ids.iter().copied().map(Some);
            let ids = ids.chain(std::iter::repeat(None));
            let rows = request.tags.iter().zip(&request.payloads).zip(ids);
            rows.map(|((&tag, payload), id)| put(id, tag, payload))
                .collect()
        }
        Entry::Remove(request, _) => request.ids.iter().map(|&id| Step::Remove(id)).collect(),
        Entry::Update(request, _) => {
            let if_revision = number(&request.if_revision);
            let tagged = request.ids.iter().zip(&request.tags);
            let step = |(&id, &tag)| Step::SetTagIf {
                id,
                tag,
                if_revision,
            };
            tagged.map(step).collect()
        }
        Entry::Write(request, _) => {
            let mut payloads = request.payloads.iter();
            let steps = request.kinds().zip(&request.ids).zip(&request.tags);
            let step = |((kind, &id), &tag)| match kind {
                StepKind::Put => put(Some(id), tag, payloads.next().expect("a payload a put")),
                StepKind::Remove => Step::Remove(id),
                StepKind::SetTag => Step::SetTag(id, tag),
                StepKind::Replace | StepKind::SetPayload | StepKind::Unspecified => {
                    panic!("no writer sends {kind:?}")
                }
            };
            steps.map(step).collect()
        }
        Entry::OpenSession(..) => Vec::new(),
        Entry::Knn(..) | Entry::Query(..) => panic!("no mutation: {entry:?}"),
    }
}
