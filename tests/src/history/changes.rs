//! The changes of points against compare-and-sets.

use std::collections::HashMap;

use super::{Call, Operation, Violation};

/// The position of a mutation in the order. It is exact if the revision is known from an answer or a record.
#[derive(Clone, Copy)]
pub(super) struct Position {
    /// The greatest revision that it may have.
    pub(super) revision: u64,
    /// The lowest revision that it may have.
    pub(super) lowest: u64,
    /// The time of its invocation.
    pub(super) invoked: u64,
}

/// The changes of points so far. They come in the order of their revisions.
pub(super) struct Changes {
    /// The lowest revision that the last change of each point may have.
    last: HashMap<u64, u64>,
    /// All changes of the points of refused compare-and-sets.
    contested: HashMap<u64, Vec<Position>>,
    /// The contradictions so far.
    pub(super) violations: Vec<Violation>,
}

impl Changes {
    pub(super) fn new(operations: &[Operation]) -> Self {
        let contested = operations.iter().filter_map(|it| match it.call {
            Call::Conflict { id, .. } => Some((id, Vec::new())),
            _ => None,
        });
        Self {
            last: HashMap::new(),
            contested: contested.collect(),
            violations: Vec::new(),
        }
    }

    /// A mutation has changed a point.
    pub(super) fn note(&mut self, id: u64, position: Position) {
        let last = self.last.entry(id).or_default();
        *last = position.lowest.max(*last);
        if let Some(changes) = self.contested.get_mut(&id) {
            changes.push(position);
        }
    }

    /// A compare-and-set takes effect: its point has not changed after the revision that it named.
    pub(super) fn compare(&mut self, id: u64, if_revision: u64, revision: u64) {
        let changed = self.last.get(&id).copied().unwrap_or_default();
        if changed > if_revision {
            self.violations.push(Violation::Overwritten {
                revision,
                id,
                changed,
            });
        }
    }

    /// True if a mutation that was invoked before this time has changed the point of a refused compare-and-set after the
    /// revision that it named.
    pub(super) fn provoke(&self, id: u64, if_revision: u64, before: u64) -> bool {
        let changes = self.contested.get(&id).map_or(&[][..], Vec::as_slice);
        let first = changes.partition_point(|it| it.revision <= if_revision);
        changes[first..].iter().any(|it| it.invoked < before)
    }
}
