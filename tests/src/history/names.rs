//! A checker of the calls for indices that clients create and delete under one name. It shares no code with the server.
//!
//! Each index has a uid of its own, so the calls tell for how long it was there at least: from the first answer that found it
//! to the first call that deletes it.
//!
//! - A name has one index at a time, which one call created.
//! - An index is gone only if a call deletes it.
//! - An index that a server has reported gone does not come back there, and no server has it at the end.
//! - The history of the points of each index holds, as [`check`](super::check) checks it, up to the first call that deletes it.

use std::collections::{BTreeMap, HashMap};

use super::{Call, NEVER, Operation, Violation};

/// A call of a client for the index of the name.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NameOperation {
    /// The server that was asked.
    pub server: u64,
    /// The client. Its calls do not overlap.
    pub client: u64,
    /// The time before the first attempt.
    pub invoked: u64,
    /// The time after the answer; [`NEVER`] without one.
    pub returned: u64,
    /// The request and its answer.
    pub call: NameCall,
}

/// The call for an index and its answer.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum NameCall {
    /// A call that creates an index, or finds the one that has the name.
    Create {
        /// The uid of the index.
        uid: String,
        /// True if the call created it.
        created: bool,
    },
    /// A call that deletes the index with this uid. Without an answer it takes effect or does not.
    Delete(String),
    /// A call for an index with this uid whose answer is that it is gone.
    Gone(String),
    /// A mutation or a read of the index with this uid.
    Points(String, Call),
    /// The uid under the name that all servers agree on at the end; none if it has no index.
    Settled(Option<String>),
}

impl NameCall {
    fn uid(&self) -> Option<&str> {
        match self {
            NameCall::Create { uid, .. }
            | NameCall::Delete(uid)
            | NameCall::Gone(uid)
            | NameCall::Points(uid, _) => Some(uid),
            NameCall::Settled(_) => None,
        }
    }
}

/// A contradiction in the calls for a name.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum NameViolation {
    /// Two indices had the name at the same time.
    Both(String, String),
    /// Two calls created this index.
    CreatedTwice(String),
    /// This index is gone, and no call had deleted it.
    Vanished(String),
    /// This index is there after it was gone.
    Returned(String),
    /// The history of the points of an index does not hold.
    Points(String, Vec<Violation>),
}

/// The numbers of indices and of operations on their points, in calls that hold.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct NamesChecked {
    /// Indices.
    pub indexes: u64,
    /// Those of them that were deleted.
    pub deleted: u64,
    /// Acknowledged mutations of points.
    pub acknowledged: u64,
    /// Reads of points.
    pub reads: u64,
}

/// The life of an index, as the calls tell it.
struct Life {
    /// The time of the first answer that found it.
    found: u64,
    /// The time of the first call that deletes it.
    deleted: u64,
    /// The time of the first answer that it is deleted or gone.
    gone: u64,
    /// The calls that created it.
    creations: u64,
}

impl Default for Life {
    fn default() -> Self {
        Self {
            found: NEVER,
            deleted: NEVER,
            gone: NEVER,
            creations: 0,
        }
    }
}

/// Checks calls in any order.
///
/// # Errors
/// All contradictions.
pub fn check(operations: &[NameOperation]) -> Result<NamesChecked, Vec<NameViolation>> {
    let lives = lives(operations);
    let mut violations = both(&lives);
    for (uid, life) in &lives {
        if life.creations > 1 {
            violations.push(NameViolation::CreatedTwice((*uid).into()));
        }
        if life.gone < NEVER && life.deleted >= life.gone {
            violations.push(NameViolation::Vanished((*uid).into()));
        }
    }
    violations.extend(returned(operations));
    for operation in operations {
        if let NameCall::Settled(settled) = &operation.call {
            violations.extend(unsettled(&lives, settled.as_deref(), operation.invoked));
        }
    }
    let mut checked = NamesChecked::default();
    for life in lives.values() {
        checked.indexes += u64::from(life.found < NEVER);
        checked.deleted += u64::from(life.gone < NEVER);
    }
    for (uid, points) in points(operations, &lives) {
        match super::check(&points) {
            Ok(of_points) => {
                checked.acknowledged += of_points.acknowledged;
                checked.reads += of_points.latest + of_points.plain;
            }
            Err(of_points) => violations.push(NameViolation::Points(uid.into(), of_points)),
        }
    }
    match violations.is_empty() {
        true => Ok(checked),
        false => Err(violations),
    }
}

fn lives(operations: &[NameOperation]) -> BTreeMap<&str, Life> {
    let mut lives = BTreeMap::<&str, Life>::new();
    for operation in operations {
        let Some(uid) = operation.call.uid() else {
            continue;
        };
        let life = lives.entry(uid).or_default();
        match operation.call {
            NameCall::Create { created, .. } => {
                life.found = life.found.min(operation.returned);
                life.creations += u64::from(created);
            }
            NameCall::Points(..) => life.found = life.found.min(operation.returned),
            NameCall::Delete(_) => {
                life.deleted = life.deleted.min(operation.invoked);
                life.gone = life.gone.min(operation.returned);
            }
            NameCall::Gone(_) => life.gone = life.gone.min(operation.returned),
            NameCall::Settled(_) => {}
        }
    }
    lives
}

/// The indices that had the name together.
fn both(lives: &BTreeMap<&str, Life>) -> Vec<NameViolation> {
    let there = lives.iter().filter(|(_, life)| life.found < life.deleted);
    let mut there: Vec<(&str, &Life)> = there.map(|(uid, life)| (*uid, life)).collect();
    there.sort_by_key(|(_, life)| life.found);
    let mut violations = Vec::new();
    let mut last: Option<(&str, u64)> = None;
    for (uid, life) in there {
        if let Some((other, until)) = last
            && life.found < until
        {
            violations.push(NameViolation::Both(other.into(), uid.into()));
        }
        if last.is_none_or(|(_, until)| until < life.deleted) {
            last = Some((uid, life.deleted));
        }
    }
    violations
}

/// The indices that came back at a server after an answer of it that they were gone.
fn returned(operations: &[NameOperation]) -> Vec<NameViolation> {
    let mut gone = HashMap::<(u64, &str), u64>::new();
    for operation in operations {
        if let NameCall::Delete(uid) | NameCall::Gone(uid) = &operation.call {
            let first = gone.entry((operation.server, uid.as_str()));
            let first = first.or_insert(NEVER);
            *first = operation.returned.min(*first);
        }
    }
    let mut violations = Vec::new();
    for operation in operations {
        let (NameCall::Create { uid, .. } | NameCall::Points(uid, _)) = &operation.call else {
            continue;
        };
        let gone = gone.get(&(operation.server, uid.as_str()));
        if operation.returned < NEVER && gone.is_some_and(|gone| *gone < operation.invoked) {
            violations.push(NameViolation::Returned(uid.clone()));
        }
    }
    violations
}

/// The contradictions of the index under the name at the end, of which the servers were asked at this time.
fn unsettled(
    lives: &BTreeMap<&str, Life>,
    settled: Option<&str>,
    asked: u64,
) -> Vec<NameViolation> {
    let mut violations = Vec::new();
    for (&uid, life) in lives {
        let is_settled = settled == Some(uid);
        if is_settled && life.gone < asked {
            violations.push(NameViolation::Returned(uid.into()));
        }
        if !is_settled && life.found < asked && life.deleted == NEVER {
            violations.push(NameViolation::Vanished(uid.into()));
        }
    }
    violations
}

/// The operations on the points of each index. An answer that came after the first call that deletes the index promises
/// nothing: the records may be gone. Its mutation may have taken effect before.
fn points<'a>(
    operations: &'a [NameOperation],
    lives: &BTreeMap<&str, Life>,
) -> BTreeMap<&'a str, Vec<Operation>> {
    let mut points = BTreeMap::<&str, Vec<Operation>>::new();
    for operation in operations {
        let NameCall::Points(uid, call) = &operation.call else {
            continue;
        };
        let is_late = operation.returned > lives[uid.as_str()].deleted;
        let (returned, call) = match call {
            Call::Mutation { steps, .. } if is_late => {
                let (steps, answer) = (steps.clone(), None);
                (NEVER, Call::Mutation { steps, answer })
            }
            _ if is_late => continue,
            call => (operation.returned, call.clone()),
        };
        points.entry(uid).or_default().push(Operation {
            client: operation.client,
            invoked: operation.invoked,
            returned,
            call,
        });
    }
    points
}
