//! The order of revisions against real time, and against what each client saw before.

use std::collections::HashMap;

use super::{Call, Operation, Violation, placed::Placed};

/// The greatest revisions that had returned when an operation was invoked.
#[derive(Clone, Copy, Default)]
pub(super) struct Returned {
    /// To any client.
    pub(super) newest: u64,
    /// To its own client.
    own: u64,
}

/// Finds the revisions that had returned before each operation.
pub(super) fn returned(operations: &[Operation], placed: &Placed) -> Vec<Returned> {
    let mut invoked: Vec<usize> = (0..operations.len()).collect();
    let mut returned = invoked.clone();
    invoked.sort_by_key(|at| operations[*at].invoked);
    returned.sort_by_key(|at| operations[*at].returned);
    let mut returned = returned.into_iter().peekable();
    let (mut newest, mut own) = (0, HashMap::<u64, u64>::new());
    let mut all = vec![Returned::default(); operations.len()];
    for at in invoked {
        let operation = &operations[at];
        while let Some(before) =
            returned.next_if(|before| operations[*before].returned < operation.invoked)
        {
            let client = own.entry(operations[before].client).or_default();
            let revision = revision(operations, placed, before).unwrap_or_default();
            *client = revision.max(*client);
            newest = newest.max(revision);
        }
        let own = own.get(&operation.client).copied().unwrap_or_default();
        all[at] = Returned { newest, own };
    }
    all
}

/// The contradictions of the revisions.
pub(super) fn check(
    operations: &[Operation],
    placed: &Placed,
    returned: &[Returned],
) -> Vec<Violation> {
    let mut violations = Vec::new();
    for (at, (operation, before)) in operations.iter().zip(returned).enumerate() {
        let Some(revision) = revision(operations, placed, at) else {
            continue;
        };
        let Returned { newest, own } = *before;
        let is_fresh = match &operation.call {
            Call::Read { latest, .. } => *latest,
            Call::Record { .. } => {
                if Some(revision) != own.checked_add(1) {
                    violations.push(Violation::NotNext {
                        client: operation.client,
                        after: own,
                        revision,
                    });
                }
                false
            }
            Call::Mutation { .. } if placed.makes_revision(operations, at) => {
                if revision <= newest {
                    violations.push(Violation::Reordered {
                        revision,
                        returned: newest,
                    });
                }
                false
            }
            Call::Mutation { .. } | Call::Conflict { .. } => true,
        };
        if is_fresh && revision < newest {
            violations.push(Violation::Stale {
                revision,
                returned: newest,
            });
        }
        if revision < own {
            violations.push(Violation::Backwards {
                client: operation.client,
                from: own,
                to: revision,
            });
        }
    }
    violations
}

/// The revision of an operation, if it is known.
fn revision(operations: &[Operation], placed: &Placed, at: usize) -> Option<u64> {
    match &operations[at].call {
        Call::Read { revision, .. } | Call::Record { revision, .. } => Some(*revision),
        Call::Mutation {
            answer: Some(answer),
            ..
        } => Some(answer.revision),
        Call::Mutation { answer: None, .. } => placed.revision(at),
        Call::Conflict { .. } => None,
    }
}
