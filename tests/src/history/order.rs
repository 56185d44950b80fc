//! The order of revisions against real time, and against what each client saw before.

use std::collections::HashMap;

use super::{Call, Operation, Violation, replay::Placed};

/// The contradictions of the revisions.
pub(super) fn check(operations: &[Operation], placed: &Placed) -> Vec<Violation> {
    let mut violations = Vec::new();
    let mut invoked: Vec<usize> = (0..operations.len()).collect();
    let mut returned = invoked.clone();
    invoked.sort_by_key(|at| operations[*at].invoked);
    returned.sort_by_key(|at| operations[*at].returned);
    let mut returned = returned.into_iter().peekable();
    // The greatest revision that had returned, and the same for each client.
    let (mut newest, mut seen) = (0, HashMap::<u64, u64>::new());
    for at in invoked {
        let operation = &operations[at];
        while let Some(before) =
            returned.next_if(|before| operations[*before].returned < operation.invoked)
        {
            let client = seen.entry(operations[before].client).or_default();
            let revision = revision(operations, placed, before).unwrap_or_default();
            *client = revision.max(*client);
            newest = newest.max(revision);
        }
        let Some(revision) = revision(operations, placed, at) else {
            continue;
        };
        let is_fresh = match &operation.call {
            Call::Read { latest, .. } => *latest,
            Call::Mutation { .. } if placed.makes_revision(operations, at) => {
                if revision <= newest {
                    violations.push(Violation::Reordered {
                        revision,
                        returned: newest,
                    });
                }
                false
            }
            Call::Mutation { .. } => true,
        };
        if is_fresh && revision < newest {
            violations.push(Violation::Stale {
                revision,
                returned: newest,
            });
        }
        let from = seen.get(&operation.client).copied().unwrap_or_default();
        if revision < from {
            violations.push(Violation::Backwards {
                client: operation.client,
                from,
                to: revision,
            });
        }
    }
    violations
}

/// The revision of an operation, if it is known.
fn revision(operations: &[Operation], placed: &Placed, at: usize) -> Option<u64> {
    match &operations[at].call {
        Call::Read { revision, .. } => Some(*revision),
        Call::Mutation {
            answer: Some(answer),
            ..
        } => Some(answer.revision),
        Call::Mutation { answer: None, .. } => placed.revision(at),
    }
}
