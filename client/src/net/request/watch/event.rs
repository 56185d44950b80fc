//! The events of a watch.

use std::time::SystemTime;

use crate::{Points, Revision};

/// An event of a watch.
#[derive(Clone, Debug, PartialEq)]
pub enum WatchEvent {
    /// The next mutation.
    Mutation(Box<Mutation>),
    /// The server cannot send the next mutations. The last event.
    Reset(Reset),
}

/// One mutation, whole. No id is both stored and removed.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub struct Mutation {
    /// The revision that it made.
    pub revision: Revision,
    /// The time of the server's clock.
    pub time: SystemTime,
    /// The points that it stored, each in the place of one with the same id. The revision of a point is that of its
    /// state: an older one than the mutation's if only the tag or the payload is new.
    pub stored: Points,
    /// The ids of the points that it removed.
    pub removed_ids: Vec<u64>,
    /// The writer session whose batch it was; 0 if it was none.
    pub session: u64,
    /// The number of the batch in its session; 0 if it was none.
    pub batch: u64,
}

/// The reason for which a watch ended, and the index's revision.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct Reset {
    /// The reason.
    pub reason: ResetReason,
    /// The newest revision that can be read, of the uid that the index has now.
    pub revision: Revision,
}

/// The reason for which a watch ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ResetReason {
    /// The index has another uid: it was deleted and created again, restored, or lost mutations that were not synced.
    /// Continue with a new handle, [`Client::index`](crate::Client::index).
    UidChanged,
    /// The server no longer keeps the next mutations.
    WindowPassed,
    /// A reason that this client does not know.
    Other(i32),
}
