//! The errors of a call, typed: cause, place and remedy. [`code`](super::code) has the kind and the reason of each.

use std::fmt;

use thiserror::Error;
use wayfold_index::SearchError;
use wayfold_proto::v1;

use crate::{
    admission::{MAX_BYTES, TooManyBytes},
    identity::Denial,
    watermark::{Resource, WatermarkExceeded},
};

/// One field that is wrong.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Violation {
    /// The field's path in the request: `states[37].coords[3]`.
    pub field: String,
    /// The kind of violation, in UPPER_SNAKE_CASE: `NAN`.
    pub reason: &'static str,
    /// The problem and the remedy.
    pub description: String,
}

impl fmt::Display for Violation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: {}", self.field, self.description)
    }
}

/// The reason why the server answers no calls.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Unavailability {
    /// It has not replayed its log yet.
    Starting,
    /// It is shutting down.
    Stopping,
}

/// The failure of a call. After [`Error::DeadlineExceeded`], [`Error::StorageFailed`], [`Error::DataLoss`] and
/// [`Error::Internal`] the outcome of a mutation is unknown. A call that fails with any other error changes nothing;
/// [`Error::Forwarded`] is like the error that the owner had.
#[derive(Clone, Debug, PartialEq, Error)]
pub enum Error {
    /// Fields of the request are wrong. At least one is named; of many, the first few.
    #[error("{}", list(violations, "; "))]
    InvalidArgument {
        /// The fields.
        violations: Vec<Violation>,
    },
    /// No index has this name.
    #[error("no index is named \"{name}\": create it, or list the indices")]
    IndexNotFound {
        /// The name.
        name: String,
    },
    /// Points that the call names are not stored.
    #[error("index \"{index}\" holds no point with {}", Ids(ids))]
    PointsNotFound {
        /// The index.
        index: String,
        /// The ids, all of them.
        ids: Vec<u64>,
    },
    /// An index of this name exists, with another space or payload encoding.
    #[error(
        "index \"{name}\" exists with the {what} {existing}, not {requested}: take another name, or delete it first"
    )]
    IndexExists {
        /// The name.
        name: String,
        /// The property that differs.
        what: &'static str,
        /// The value of the existing index, as text.
        existing: String,
        /// The requested value, as text.
        requested: String,
    },
    /// The name for a restored index is taken.
    #[error(
        "an index is named \"{name}\" already: restore under another name, or delete that one first"
    )]
    NameTaken {
        /// The name.
        name: String,
    },
    /// Ids of an insert hold different points.
    #[error(
        "index \"{index}\" holds different points under {}: set on_conflict to REPLACE to replace them",
        Ids(ids)
    )]
    PointsExist {
        /// The index.
        index: String,
        /// The ids, all of them.
        ids: Vec<u64>,
    },
    /// New points have ids that a writer session reserved.
    #[error(
        "index \"{index}\": another writer session reserved {}: take ids that your session reserved, or let the server \
         assign them",
        Ids(ids)
    )]
    IdsReserved {
        /// The index.
        index: String,
        /// The ids, all of them.
        ids: Vec<u64>,
    },
    /// A session does not take this batch.
    #[error(
        "index \"{index}\": writer session {session} does not take batch {batch}: {}",
        match newest {
            Some(newest) => format!("its newest batch is {newest}, and one batch is under way at a time"),
            None => "it has ended, or was never opened; open a new session".into(),
        }
    )]
    SessionRefused {
        /// The index.
        index: String,
        /// The session.
        session: u64,
        /// The number of the batch.
        batch: u64,
        /// The number of the session's newest batch; None if there is no such session.
        newest: Option<u64>,
    },
    /// A batch number came back with another request.
    #[error(
        "batch: batch {batch} of writer session {session} was another request: a retry repeats the request to the \
         letter, and a new request is the next batch"
    )]
    BatchMismatch {
        /// The session.
        session: u64,
        /// The number of the batch.
        batch: u64,
    },
    /// The index has another uid: it was deleted and created again, or restored.
    #[error(
        "index \"{index}\" has the uid {found}, not {requested}: it has another history, so revisions and ids of the old \
         one mean nothing here"
    )]
    UidMismatch {
        /// The index.
        index: String,
        /// The requested uid.
        requested: String,
        /// The index's uid.
        found: String,
    },
    /// This server of a cluster has not heard of the index with this uid, and another one may have.
    #[error("index \"{index}\": nothing is known here of the uid {requested} yet: try again")]
    UidUnknown {
        /// The index.
        index: String,
        /// The requested uid.
        requested: String,
    },
    /// Points changed after the revision that the call compares with.
    #[error(
        "index \"{index}\": the points with {} changed after revision {if_revision}: read them again",
        Ids(ids)
    )]
    RevisionConflict {
        /// The index.
        index: String,
        /// The revision compared with.
        if_revision: u64,
        /// The ids of the points that changed, all of them.
        ids: Vec<u64>,
    },
    /// The call exceeds a limit of the server.
    #[error("{requested} is above the limit {limit} = {value}: {advice}")]
    LimitExceeded {
        /// The limit's name in the settings.
        limit: &'static str,
        /// Its value.
        value: u64,
        /// The requested amount; for `max_answer_bytes` the size at which the server stopped building the answer.
        requested: u64,
        /// The remedy.
        advice: &'static str,
    },
    /// Requests, calls and unread answers hold the bytes that they may.
    #[error(
        "requests, calls and unread answers hold the {most} bytes that {} or an eighth of the memory limit allows, or this \
         connection's share of them: read the answers, and try again later",
        MAX_BYTES
    )]
    TooManyBytes {
        /// The most bytes.
        most: usize,
    },
    /// The memory or the disk is above its watermark, and the call would grow the server.
    #[error(
        "{full}. Reads, removals and deletions go on: remove points, delete an index, or {}",
        match full.resource {
            Resource::Memory => "give the server more memory (memory.limit_bytes)",
            Resource::Disk => "free space on its disk (disk.min_free_bytes)",
        }
    )]
    Full {
        /// The resource and its use.
        full: WatermarkExceeded,
    },
    /// The index would exceed a quota.
    #[error(
        "index \"{index}\": {requested} exceed its quota {limit} = {value}: remove points, or raise it"
    )]
    QuotaExceeded {
        /// The index.
        index: String,
        /// The quota's name in the settings.
        limit: &'static str,
        /// Its value.
        value: u64,
        /// The points or bytes that the index would hold after the call.
        requested: u64,
    },
    /// The index is not in memory.
    #[error(
        "index \"{index}\" is not loaded: its {points} points take about {needed} bytes of memory, too many when it was to be \
         loaded ({full}). Delete indices, or give the server more memory (memory.limit_bytes); then it loads the index"
    )]
    NotLoaded {
        /// The index.
        index: String,
        /// The number of its points.
        points: usize,
        /// About the bytes that they take.
        needed: u64,
        /// The memory when it was loaded.
        full: WatermarkExceeded,
    },
    /// No ids are left to assign.
    #[error(
        "index \"{index}\" has no ids left to assign below 2^63, since one near it was given: give ids yourself, or \
         start a new index"
    )]
    IdsExhausted {
        /// The index.
        index: String,
    },
    /// A scan held its snapshot longer than allowed.
    #[error(
        "the scan held its snapshot for longer than max_scan_seconds = {max_scan_seconds}: go on at a newer revision with \
         {}",
        match after_id {
            Some(id) => format!("after_id = {id}"),
            None => "a new scan".into(),
        }
    )]
    ScanTooLong {
        /// The limit.
        max_scan_seconds: u64,
        /// The last id that was sent.
        after_id: Option<u64>,
    },
    /// The revision that a page of a scan names is not held.
    #[error(
        "index \"{index}\": the revision of this scan is not held any more: the scan has ended, or was too slow; scan again"
    )]
    ScanEnded {
        /// The index.
        index: String,
    },
    /// A snapshot or a verification held its revision longer than allowed.
    #[error(
        "the {what} held its revision for longer than max_scan_seconds = {max_scan_seconds}: read it faster, or raise \
         the limit"
    )]
    HeldTooLong {
        /// "snapshot" or "verification".
        what: &'static str,
        /// The limit.
        max_scan_seconds: u64,
    },
    /// The server answers no calls now.
    #[error(
        "the server is {}: try again in a moment",
        match why {
            Unavailability::Starting => "starting",
            Unavailability::Stopping => "stopping",
        }
    )]
    Unavailable {
        /// The reason.
        why: Unavailability,
    },
    /// The caller may not make this call.
    #[error("{why}")]
    Denied {
        /// The reason.
        why: Denial,
    },
    /// The deadline passed.
    #[error("the deadline passed {doing}")]
    DeadlineExceeded {
        /// The activity: "while searching".
        doing: &'static str,
    },
    /// An operation id was used again with another request.
    #[error(
        "operation_id: \"{operation_id}\" was used for another request: a retry repeats the request to the letter, \
         and a new request needs a new id"
    )]
    OperationMismatch {
        /// The operation id.
        operation_id: String,
    },
    /// The owner of the index, another server, refused the call.
    #[error("{}", status.message)]
    Forwarded {
        /// The owner's answer.
        status: Box<v1::Status>,
    },
    /// The store cannot be written, or is reopening.
    #[error("{what}")]
    StorageFailed {
        /// The failure and its consequence.
        what: String,
    },
    /// Stored data is damaged.
    #[error("{what}")]
    DataLoss {
        /// The loss and its place.
        what: String,
    },
    /// A bug of the server.
    #[error("a bug in the server: {what}")]
    Internal {
        /// The event.
        what: String,
    },
}

/// The service searches for canonical states only: a refusal is a bug.
impl From<SearchError> for Error {
    fn from(error: SearchError) -> Self {
        match error {
            SearchError::TimedOut => Error::DeadlineExceeded {
                doing: "while searching",
            },
            refused => Error::Internal {
                what: format!("a search that was checked is refused: {refused}"),
            },
        }
    }
}

impl From<TooManyBytes> for Error {
    fn from(TooManyBytes(most): TooManyBytes) -> Self {
        Error::TooManyBytes { most }
    }
}

fn list<T: ToString>(items: &[T], separator: &str) -> String {
    let items: Vec<String> = items.iter().map(T::to_string).collect();
    items.join(separator)
}

/// Ids in a message: the first few, and the number of the rest.
struct Ids<'a>(&'a [u64]);

impl fmt::Display for Ids<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        const MAX_SHOWN: usize = 10;
        let plural = if self.0.len() == 1 { "id" } else { "ids" };
        let shown = &self.0[..self.0.len().min(MAX_SHOWN)];
        write!(f, "{plural} {}", list(shown, ", "))?;
        match self.0.len() - shown.len() {
            0 => Ok(()),
            more => write!(f, " and {more} more"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn messages_name_a_few_ids_and_count_the_rest() {
        let error = |ids: Vec<u64>| Error::PointsNotFound {
            index: "arm".into(),
            ids,
        };
        assert_eq!(
            error(vec![7]).to_string(),
            "index \"arm\" holds no point with id 7"
        );
        assert_eq!(
            error((0..12).collect()).to_string(),
            "index \"arm\" holds no point with ids 0, 1, 2, 3, 4, 5, 6, 7, 8, 9 and 2 more"
        );
    }
}
