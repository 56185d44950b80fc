//! The mutations without an answer whose points were seen.

use std::collections::HashMap;

use super::{Answer, Call, Operation, Step, Violation};

/// See the module.
#[derive(Default)]
pub(super) struct Placed {
    /// The revision of each, by its place in the history.
    revisions: HashMap<usize, u64>,
    /// The ids of its points, by their payloads.
    ids: HashMap<u64, u64>,
}

impl Placed {
    /// Their number.
    pub(super) fn count(&self) -> u64 {
        self.revisions.len() as u64
    }

    pub(super) fn revision(&self, at: usize) -> Option<u64> {
        self.revisions.get(&at).copied()
    }

    /// The id of the point with this payload.
    pub(super) fn id(&self, payload: u64) -> Option<u64> {
        self.ids.get(&payload).copied()
    }

    /// True if the mutation is known to have made its revision.
    pub(super) fn makes_revision(&self, operations: &[Operation], at: usize) -> bool {
        match operations[at].call {
            Call::Mutation {
                answer: Some(Answer { changed, .. }),
                ..
            } => changed,
            Call::Mutation { answer: None, .. } => self.revisions.contains_key(&at),
            Call::Read { .. } | Call::Conflict { .. } | Call::Record { .. } => false,
        }
    }
}

/// Finds the mutations without an answer by the payloads that only they could have stored.
pub(super) fn place(operations: &[Operation]) -> Result<Placed, Vec<Violation>> {
    let mut unknown = HashMap::new();
    for (at, operation) in operations.iter().enumerate() {
        if let Call::Mutation {
            steps,
            answer: None,
        } = &operation.call
        {
            for step in steps {
                if let Step::Put { payload, .. } = step {
                    unknown.insert(*payload, at);
                }
            }
        }
    }
    let mut placed = Placed::default();
    for (&id, point) in operations.iter().flat_map(|it| it.call.points()).flatten() {
        let Some(&at) = unknown.get(&point.payload) else {
            continue;
        };
        let revision = *placed.revisions.entry(at).or_insert(point.stored);
        let known = *placed.ids.entry(point.payload).or_insert(id);
        if (revision, known) != (point.stored, id) {
            let revision = point.stored;
            return Err(vec![Violation::Twice { revision, id }]);
        }
    }
    Ok(placed)
}
