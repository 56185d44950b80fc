//! A checker of the histories of clients that share an index. It shares no code with the server.
//!
//! Each mutation has a revision, so the order of the mutations is known, and the check needs no search:
//!
//! - the order of revisions respects real time: an operation that returned before a mutation was invoked has a lower
//!   revision, and a read with `latest` has no lower revision than an operation that returned before it was invoked;
//! - no client goes backwards;
//! - each read sees the effects of the mutations up to its revision, each once and no other;
//! - a mutation that found nothing to change had nothing to change at its revision.

mod order;
mod replay;

use std::{
    collections::BTreeMap,
    hash::{DefaultHasher, Hash, Hasher},
};

/// An operation of a client. Times are nanoseconds on one clock.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Operation {
    /// The client. Its operations do not overlap.
    pub client: u64,
    /// The time before the first attempt.
    pub invoked: u64,
    /// The time after the answer; [`NEVER`] without one.
    pub returned: u64,
    /// The request and its answer.
    pub call: Call,
}

/// The time of an answer that never came.
pub const NEVER: u64 = u64::MAX;

/// The call of an operation and its answer.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Call {
    /// A mutation.
    Mutation {
        /// Its steps, in their order.
        steps: Vec<Step>,
        /// Its answer. Without one it takes effect once or never.
        answer: Option<Answer>,
    },
    /// A read.
    Read {
        /// True if it asks for all that was acknowledged before.
        latest: bool,
        /// The revision in the answer.
        revision: u64,
        /// The content of the answer.
        seen: ReadPoints,
    },
}

/// The answer to a mutation.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Answer {
    /// Its revision.
    pub revision: u64,
    /// False if it found nothing to change: the revision is another's.
    pub changed: bool,
}

/// One step of a mutation.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Step {
    /// Stores a point.
    Put {
        /// Its id; none if the answer with the id did not come.
        id: Option<u64>,
        /// Its tag.
        tag: u64,
        /// The digest of its payload, which no other step has.
        payload: u64,
    },
    /// Removes a point if it is stored.
    Remove(u64),
    /// Changes the tag of a point if it is stored.
    SetTag(u64, u64),
}

/// The points in the answer to a read.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ReadPoints {
    /// All points.
    All(BTreeMap<u64, Point>),
    /// These points; none is missing.
    These(BTreeMap<u64, Point>),
}

impl ReadPoints {
    fn points(&self) -> &BTreeMap<u64, Point> {
        let (ReadPoints::All(points) | ReadPoints::These(points)) = self;
        points
    }
}

/// A point in an answer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Point {
    /// Its tag.
    pub tag: u64,
    /// The digest of its payload.
    pub payload: u64,
    /// The digest of its coordinates.
    pub state: u64,
    /// The revision that stored it.
    pub stored: u64,
}

/// A digest of anything.
pub fn digest(of: &(impl Hash + ?Sized)) -> u64 {
    let mut hasher = DefaultHasher::new();
    of.hash(&mut hasher);
    hasher.finish()
}

/// A contradiction in a history.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Violation {
    /// A read, or the answer of a mutation that changed nothing, lacks the effect of an acknowledged mutation.
    Lost {
        /// The revision of the read, or of the answer.
        read: u64,
        /// The point.
        id: u64,
        /// The revision that is not to be seen.
        revision: u64,
    },
    /// A mutation took effect twice.
    Twice {
        /// The revision at which the second effect was seen.
        revision: u64,
        /// The point with the second effect.
        id: u64,
    },
    /// A mutation without an answer took effect in part.
    Torn {
        /// Its revision.
        revision: u64,
    },
    /// A read with `latest`, or the answer of a mutation without effect, is older than what had returned before.
    Stale {
        /// Its revision.
        revision: u64,
        /// The revision that had returned.
        returned: u64,
    },
    /// A mutation has a revision that had returned before the mutation was invoked, or a lower one.
    Reordered {
        /// Its revision.
        revision: u64,
        /// The revision that had returned.
        returned: u64,
    },
    /// A read has something that no mutation up to its revision has stored.
    NoPrefix {
        /// Its revision.
        read: u64,
        /// The point.
        id: u64,
    },
    /// Two answers of the same revision differ.
    Divergent {
        /// Their revision.
        revision: u64,
    },
    /// A client saw an older revision than before.
    Backwards {
        /// The client.
        client: u64,
        /// The revision that it had seen.
        from: u64,
        /// The revision that it saw then.
        to: u64,
    },
}

/// The numbers of operations in a history that holds.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Checked {
    /// Mutations with an answer.
    pub acknowledged: u64,
    /// Mutations without an answer whose effect was seen.
    pub found: u64,
    /// Reads with `latest`.
    pub latest: u64,
    /// Other reads.
    pub plain: u64,
}

/// Checks a history in any order.
///
/// # Errors
/// All contradictions of the order; if there is none, those of the contents.
pub fn check(operations: &[Operation]) -> Result<Checked, Vec<Violation>> {
    let placed = replay::place(operations)?;
    let returned = order::returned(operations, &placed);
    let violations = order::check(operations, &placed, &returned);
    if !violations.is_empty() {
        return Err(violations);
    }
    let found = replay::check(operations, &placed, &returned)?;
    let mut checked = Checked {
        found,
        ..Checked::default()
    };
    for operation in operations {
        match &operation.call {
            Call::Mutation { answer, .. } => checked.acknowledged += u64::from(answer.is_some()),
            Call::Read { latest: true, .. } => checked.latest += 1,
            Call::Read { .. } => checked.plain += 1,
        }
    }
    Ok(checked)
}
