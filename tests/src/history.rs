//! A checker of the histories of clients that share an index. It shares no code with the server.
//!
//! Each mutation has a revision, so the order of the mutations is known, and the check needs no search:
//!
//! - the order of revisions respects real time: an operation that returned before a mutation was invoked has a lower
//!   revision, and a read with `latest` has no lower revision than an operation that returned before it was invoked;
//! - no client goes backwards;
//! - each read sees the effects of the mutations up to its revision, each once and no other;
//! - a mutation that found nothing to change finds nothing at its revision in the replay;
//! - a compare-and-set took effect only if its point had not changed after the revision that it named, and was refused only if
//!   the point may have changed after it;
//! - a follower gets each record once and in order, with the effects of the mutation of its revision and no others.
//!
//! [`names`] checks the calls for indices that are created and deleted.

mod changes;
pub mod names;
mod order;
mod placed;
mod replay;

use std::{
    collections::{BTreeMap, BTreeSet},
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
    /// A compare-and-set that was refused because its point had changed.
    Conflict {
        /// The point.
        id: u64,
        /// The revision that it named.
        if_revision: u64,
    },
    /// A record that a follower got: all that the mutation of its revision did.
    Record {
        /// Its revision.
        revision: u64,
        /// The points that it stored or changed, as they are then.
        stored: BTreeMap<u64, Point>,
        /// The points that it removed.
        removed: BTreeSet<u64>,
    },
}

impl Call {
    /// The points that the answer tells.
    fn points(&self) -> Option<&BTreeMap<u64, Point>> {
        match self {
            Call::Read { seen, .. } => Some(seen.points()),
            Call::Record { stored, .. } => Some(stored),
            Call::Mutation { .. } | Call::Conflict { .. } => None,
        }
    }
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
    /// Changes the tag of a point; the mutation is refused if the point changed after a revision.
    SetTagIf {
        /// The point.
        id: u64,
        /// Its new tag.
        tag: u64,
        /// The revision.
        if_revision: u64,
    },
}

impl Step {
    /// The point that it removes or whose tag it changes, and the new tag.
    fn target(self) -> Option<(u64, Option<u64>)> {
        match self {
            Step::Put { .. } => None,
            Step::Remove(id) => Some((id, None)),
            Step::SetTag(id, tag) | Step::SetTagIf { id, tag, .. } => Some((id, Some(tag))),
        }
    }
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
    /// A compare-and-set took effect though its point had changed.
    Overwritten {
        /// Its revision.
        revision: u64,
        /// The point.
        id: u64,
        /// The revision that had changed the point, after the one that the compare-and-set named.
        changed: u64,
    },
    /// A compare-and-set was refused though nothing can have changed its point after the revision that it named.
    Unprovoked {
        /// The point.
        id: u64,
        /// The revision that it named.
        if_revision: u64,
    },
    /// A follower got a record that is not the next one.
    NotNext {
        /// The follower.
        client: u64,
        /// The revision that it had.
        after: u64,
        /// The revision of the record.
        revision: u64,
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
    /// Compare-and-sets that were refused because their points had changed.
    pub conflicts: u64,
    /// Records of followers.
    pub records: u64,
}

/// Checks a history in any order.
///
/// # Errors
/// All contradictions of the order; if there is none, those of the contents.
pub fn check(operations: &[Operation]) -> Result<Checked, Vec<Violation>> {
    let placed = placed::place(operations)?;
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
            Call::Conflict { .. } => checked.conflicts += 1,
            Call::Record { .. } => checked.records += 1,
        }
    }
    Ok(checked)
}
