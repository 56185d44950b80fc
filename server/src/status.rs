//! The status of a failed call, as data for every face: one error, one status.
//!
//! [`v1::Status`] is a google.rpc.Status field for field, with details of google.rpc; each face puts it into its own
//! form.

mod details;

use std::{collections::HashMap, time::Duration};

pub(crate) use details::DETAIL_DESCRIPTORS;

use tracing::error;
use wayfold_proto::v1;

use crate::{
    admission::{MAX_BYTES, Overloaded, QUEUE_TARGET_MS},
    identity::{Denial, IdentificationError},
    observe::SparseLines,
    service::{Code, Damaged, Error, Listing, MAX_HELD_SCANS, Violation},
};

/// The domain of every `ErrorInfo`.
pub(crate) const DOMAIN: &str = "wayfold";

/// The pause that a busy server asks for: most calls take a few milliseconds.
const BUSY_PAUSE: Duration = Duration::from_millis(50);

/// The pause that a server asks for until somebody has removed points or ended a scan.
const FULL_PAUSE: Duration = Duration::from_secs(1);

// A status travels in HTTP/2 headers, which stock clients limit to 8 KiB in all, and its text goes twice. Text from a
// caller has any length, so every part is bounded.
const MAX_MESSAGE_BYTES: usize = 512;
const MAX_VIOLATIONS: usize = 8;
const MAX_TEXT_BYTES: usize = 160;
const MAX_IDS: usize = 64;

/// The failure of a call.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Status {
    pub(crate) code: Code,
    /// In UPPER_SNAKE_CASE.
    pub(crate) reason: &'static str,
    pub(crate) message: String,
    metadata: HashMap<String, String>,
    detail: Option<Detail>,
    /// The same call may succeed after this time.
    retry_delay: Option<Duration>,
    /// The whole status, if another server gave it.
    given: Option<v1::Status>,
}

/// The machine-readable detail that accompanies the reason.
#[derive(Clone, Debug, PartialEq)]
enum Detail {
    /// The wrong fields.
    Fields(Vec<Violation>),
    /// The missing or conflicting resource: its type and its name.
    Resource(&'static str, String),
    /// The index that is in another state.
    Precondition(String),
    /// The exceeded limit and its value.
    Quota(&'static str, u64),
}

impl Detail {
    /// The field at which the error lies.
    fn of_field(field: &str, error: &Error) -> Self {
        Self::Fields(vec![Violation {
            field: field.to_owned(),
            reason: error.reason(),
            description: error.to_string(),
        }])
    }
}

/// The status of a failed call.
pub(crate) fn from_error(error: &Error) -> Status {
    // Apart, so that calls of a damaged index hide no bug.
    static OF_BUGS: SparseLines = SparseLines::new();
    static OF_DAMAGE: SparseLines = SparseLines::new();
    let left_out = match error.code() {
        Code::Internal => OF_BUGS.next(),
        Code::DataLoss => OF_DAMAGE.next(),
        _ => None,
    };
    if let Some(left_out) = left_out {
        error!(%error, left_out, "call failed");
    }
    describing(error)
}

/// The status of an error that failed no call: it is not logged.
fn describing(error: &Error) -> Status {
    let mut status = Status {
        code: error.code(),
        reason: error.reason(),
        message: bounded(error, MAX_MESSAGE_BYTES),
        metadata: HashMap::new(),
        detail: None,
        retry_delay: match error {
            Error::Full { .. }
            | Error::LimitExceeded {
                limit: MAX_HELD_SCANS,
                ..
            } => Some(FULL_PAUSE),
            Error::TooManyBytes { .. }
            | Error::Denied {
                why: Denial::Unknown(IdentificationError::TooManyCalls(_)),
            } => Some(BUSY_PAUSE),
            _ => None,
        },
        given: match error {
            Error::Forwarded { status } => Some(v1::Status::clone(status)),
            _ => None,
        },
    };
    status.detail = status.describe(error);
    status
}

/// The status of a call that exceeds a limit of a face.
pub(crate) fn limit(
    reason: &'static str,
    message: String,
    limit: &'static str,
    value: usize,
) -> Status {
    let mut status = Status {
        code: Code::ResourceExhausted,
        reason,
        message,
        metadata: HashMap::new(),
        detail: None,
        retry_delay: None,
        given: None,
    };
    status.detail = Some(status.quota(limit, value as u64));
    status
}

/// The status of a call that exceeds a limit of a face now, and may not do so later.
pub(crate) fn busy(
    reason: &'static str,
    message: String,
    limit: &'static str,
    value: usize,
) -> Status {
    Status {
        retry_delay: Some(BUSY_PAUSE),
        ..self::limit(reason, message, limit, value)
    }
}

/// The status of a call while as many others are under way as `limit` allows.
pub(crate) fn too_many_calls(limit: &'static str, value: usize, advice: &str) -> Status {
    let message = format!("as many calls are under way as {limit} = {value} allows: {advice}");
    busy("TOO_MANY_CALLS", message, limit, value)
}

/// The status of a call that waited to begin for too long.
pub(crate) fn overloaded(Overloaded(target): Overloaded) -> Status {
    let most = target.as_millis() as usize;
    let message =
        format!("calls wait longer than {QUEUE_TARGET_MS} = {most} allows: try again later");
    busy("OVERLOADED", message, QUEUE_TARGET_MS, most)
}

/// The status of a call while requests, calls and unread answers hold `most` bytes, or those of its flow their share.
pub(crate) fn too_many_bytes(most: usize) -> Status {
    describing(&Error::TooManyBytes { most })
}

/// A page of the indices, with a status for each that cannot be read.
pub(crate) fn listing(listing: Listing) -> v1::ListIndexesResponse {
    let damaged = |damaged: Damaged| v1::DamagedIndex {
        error: Some(describing(&damaged.error).to_message()),
        name: damaged.name,
        uid: damaged.uid,
    };
    v1::ListIndexesResponse {
        indexes: listing.indexes,
        next_page_token: listing.next_page_token,
        damaged: listing.damaged.into_iter().map(damaged).collect(),
    }
}

impl Status {
    /// Sets the metadata of an error, and returns its detail.
    fn describe(&mut self, error: &Error) -> Option<Detail> {
        Some(match error {
            Error::InvalidArgument { violations } => {
                let shown = violations.iter().take(MAX_VIOLATIONS);
                Detail::Fields(shown.cloned().collect())
            }
            Error::OperationMismatch { operation_id } => {
                self.set("operation_id", operation_id);
                Detail::of_field("operation_id", error)
            }
            Error::IndexNotFound { name } | Error::NameTaken { name } => {
                Detail::Resource("wayfold.v1.Index", name.clone())
            }
            Error::BatchMismatch { session, batch } => {
                self.set("session", session);
                self.set("batch", batch);
                Detail::of_field("batch", error)
            }
            Error::SessionRefused {
                index,
                session,
                batch,
                newest,
            } => {
                self.set("session", session);
                self.set("batch", batch);
                if let Some(newest) = newest {
                    self.set("newest_batch", newest);
                }
                self.precondition(index)
            }
            Error::PointsNotFound { index, ids }
            | Error::PointsExist { index, ids }
            | Error::IdsReserved { index, ids } => {
                self.set("index", index);
                self.set_ids(ids);
                let name = ids.first().map_or(String::new(), u64::to_string);
                Detail::Resource("wayfold.v1.Point", name)
            }
            Error::IndexExists {
                name,
                existing,
                requested,
                ..
            } => {
                self.set("existing", existing);
                self.set("requested", requested);
                Detail::Resource("wayfold.v1.Index", name.clone())
            }
            Error::UidMismatch {
                index,
                requested,
                found,
            } => {
                self.set("requested", requested);
                self.set("found", found);
                self.precondition(index)
            }
            Error::UidUnknown { index, requested } => {
                self.set("requested", requested);
                self.precondition(index)
            }
            Error::RevisionConflict {
                index,
                if_revision,
                ids,
            } => {
                self.set("if_revision", if_revision);
                self.set_ids(ids);
                self.precondition(index)
            }
            Error::ScanEnded { index } => {
                self.set("index", index);
                Detail::Precondition(index.clone())
            }
            Error::LimitExceeded {
                limit,
                value,
                requested,
                advice: _,
            } => {
                self.set("requested", requested);
                self.quota(limit, *value)
            }
            Error::TooManyBytes { most } => self.quota(MAX_BYTES, *most as u64),
            Error::Full { full } => {
                self.set("used", full.used);
                self.quota(full.resource.setting(), full.high)
            }
            Error::QuotaExceeded {
                index,
                limit,
                value,
                requested,
            } => {
                self.set("index", index);
                self.set("requested", requested);
                self.quota(limit, *value)
            }
            Error::NotLoaded {
                index,
                points,
                needed,
                full,
            } => {
                self.set("index", index);
                self.set("points", points);
                self.set("needed", needed);
                self.set("used", full.used);
                self.quota(full.resource.setting(), full.high)
            }
            Error::IdsExhausted { index } => {
                self.set("index", index);
                Detail::Quota("ids", 1 << 63)
            }
            Error::ScanTooLong {
                max_scan_seconds,
                after_id,
            } => {
                if let Some(id) = after_id {
                    self.set("after_id", id);
                }
                self.quota("max_scan_seconds", *max_scan_seconds)
            }
            Error::HeldTooLong {
                what: _,
                max_scan_seconds,
            } => self.quota("max_scan_seconds", *max_scan_seconds),
            Error::Denied {
                why: Denial::Role { identity, needed },
            } => {
                self.set("identity", identity);
                self.set("needed", needed);
                return None;
            }
            Error::Denied {
                why: Denial::Index { identity, index },
            } => {
                self.set("identity", identity);
                self.set("index", index);
                return None;
            }
            Error::Denied {
                why: Denial::Metrics { identity },
            } => {
                self.set("identity", identity);
                return None;
            }
            Error::Denied {
                why: Denial::Unknown(IdentificationError::TooManyCalls(most)),
            } => self.quota("max_calls", *most as u64),
            Error::Denied {
                why: Denial::Unknown(_),
            }
            | Error::Unavailable { why: _ }
            | Error::Forwarded { status: _ }
            | Error::DeadlineExceeded { doing: _ }
            | Error::StorageFailed { what: _ }
            | Error::DataLoss { what: _ }
            | Error::Internal { what: _ } => return None,
        })
    }

    fn quota(&mut self, limit: &'static str, value: u64) -> Detail {
        self.set("limit", limit);
        self.set("value", value);
        Detail::Quota(limit, value)
    }

    fn precondition(&mut self, index: &str) -> Detail {
        self.set("index", index);
        Detail::Precondition(index.to_owned())
    }

    fn set(&mut self, key: &str, value: impl ToString) {
        let value = bounded(value, MAX_TEXT_BYTES);
        self.metadata.insert(key.to_owned(), value);
    }

    /// The first of `ids`, separated by commas, and how many there are.
    fn set_ids(&mut self, ids: &[u64]) {
        let shown: Vec<String> = ids.iter().take(MAX_IDS).map(u64::to_string).collect();
        self.metadata.insert("ids".to_owned(), shown.join(","));
        self.set("ids_total", ids.len());
    }
}

/// `text`, or as much of it as fits into `max` bytes.
fn bounded(text: impl ToString, max: usize) -> String {
    const MARK: &str = "…";
    let mut text = text.to_string();
    if text.len() > max {
        let mut end = max - MARK.len();
        while !text.is_char_boundary(end) {
            end -= 1;
        }
        text.truncate(end);
        text.push_str(MARK);
    }
    text
}

#[cfg(test)]
mod tests;
