//! The errors of calls.

use std::{path::PathBuf, sync::Arc, time::Duration};

#[cfg(feature = "net")]
use crate::{Code, Refusal, SnapshotError};
use thiserror::Error;
use wayfold_index::{ApplyError, PointsError, SearchError, StateError};

/// The error of a call.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum Error {
    /// The given address is not that of a server.
    #[error(
        "{uri:?} is not the address of a server ({problem}); one looks like http://127.0.0.1:50051"
    )]
    Address {
        /// The text that was given.
        uri: String,
        /// The problem with it.
        problem: String,
    },
    /// A certificate, a key or a token cannot be used.
    #[error("{what}, {}: {problem}", file.display())]
    Credential {
        /// The kind of the credential.
        what: &'static str,
        /// Its file.
        file: PathBuf,
        /// The problem with it.
        problem: String,
    },
    /// The server could not be reached, or the connection broke. The effect of a mutation is unknown; the same call
    /// again, with the same operation id, takes effect once.
    #[error("{call}: no connection to {uri}: {}", root_cause(source.as_ref()))]
    Connection {
        /// The call.
        call: &'static str,
        /// The server's address.
        uri: String,
        /// The error that the transport reported.
        source: Box<dyn std::error::Error + Send + Sync>,
    },
    /// The server and the client did not accept each other's certificates, or the server speaks no TLS. No retry
    /// follows.
    #[error("the TLS handshake with {uri} failed: {problem}")]
    Handshake {
        /// The server's address.
        uri: String,
        /// The problem.
        problem: String,
    },
    /// No answer arrived in time. The effect of a mutation is unknown; the same call again, with the same operation
    /// id, takes effect once. A write of a shared index that waited for room in vain has stored nothing, or only the
    /// rows that [`Error::Partial`] counts; after a `flush` the writes stay pending.
    #[error("{call}: no answer within {timeout:?}{}", earlier_attempt(earlier.as_deref()))]
    Timeout {
        /// The call.
        call: &'static str,
        /// The time that the client waited, attempts and pauses included.
        timeout: Duration,
        /// The error of an attempt before the last one, if there was one.
        earlier: Option<Box<Error>>,
    },
    /// The server refused the call. The outcome of a mutation is unknown after `DEADLINE_EXCEEDED`, `DATA_LOSS`,
    /// `INTERNAL`, `CANCELLED`, `UNKNOWN`, and `UNAVAILABLE` with the reason `STORAGE_FAILED`, and if an earlier try of the
    /// call ended so; any other refusal changed nothing. [`Error::may_have_taken_effect`] tells.
    #[cfg(feature = "net")]
    #[error(transparent)]
    Refused(Box<Refusal>),
    /// A state does not have as many numbers as the space has coordinates.
    #[error("states[{row}]: {found} numbers, where a state of this space has {expected}")]
    Width {
        /// The index of the state among those given.
        row: usize,
        /// The space's coordinates.
        expected: usize,
        /// The state's numbers.
        found: usize,
    },
    /// The coordinates of a typed state are not those of the space: an `Isometry3` where the quaternion comes first.
    #[error("{state} is laid out as {given}, but a state of {space} as {expected}")]
    Layout {
        /// The type of the state.
        state: &'static str,
        /// The names of its coordinates.
        given: String,
        /// The space.
        space: String,
        /// The names of the space's coordinates.
        expected: String,
    },
    /// The numbers of a state are not a state of the space.
    #[error("states[{row}].{error}")]
    State {
        /// The index of the state among those given.
        row: usize,
        /// The problem of the state.
        error: StateError,
    },
    /// An insert names the id of a stored point, or one that the index assigns.
    #[error("id {id}: a point has it, or the index assigns it; replace moves a stored point")]
    IdTaken {
        /// The id.
        id: u64,
    },
    /// A search took longer than [`Search::timeout`](crate::Search::timeout).
    #[error("the search did not end within its timeout")]
    SearchTimeout,
    /// A call that is for indices in memory only.
    #[error(
        "{call}: others may use the points of this index; only an index in memory has this call"
    )]
    NotInMemory {
        /// The call.
        call: &'static str,
    },
    /// The server refused a write of a shared index for good. The writes from there on wait for
    /// [`Index::take_unsent`](crate::Index::take_unsent).
    #[error("the server refused a write, and nothing after it was sent: {why}")]
    WritesRefused {
        /// The refusal.
        why: Arc<Error>,
    },
    /// The index was closed.
    #[error("the index is closed")]
    Closed,
    /// The index was made in another process, from which this one was forked: its threads are not here, and one of
    /// them may have held a lock. Nor can this process open an index of a server if the other one had opened any.
    #[error(
        "this process was forked after an index was opened: fork before that, or start a process anew"
    )]
    Forked,
    /// The program has interrupted a call that waited: see [`set_interrupt_check`](crate::set_interrupt_check). The effect of
    /// a mutation of a remote index is unknown. A write of a shared index has stored nothing, or only the rows that
    /// [`Error::Partial`] counts.
    #[error("the wait was interrupted")]
    Interrupted,
    /// The thread that talks to servers could not be started.
    #[error("no thread to talk to servers: {source}")]
    Thread {
        /// The reason.
        source: Arc<std::io::Error>,
    },
    /// The index was created again with another space.
    #[error("index {index} has the space {found} now, not {expected}")]
    OtherSpace {
        /// Its name.
        index: String,
        /// The space it was opened with.
        expected: String,
        /// Its space now.
        found: String,
    },
    /// An argument that is out of its range.
    #[error("{field}: {problem}")]
    Argument {
        /// The argument.
        field: &'static str,
        /// The problem with it.
        problem: String,
    },
    /// A mutation that was sent in several calls failed after some of them had taken effect.
    #[error("rows 0 to {} of {rows} took effect; then: {source}", done - 1)]
    Partial {
        /// The number of rows that took effect, in order from the first. Row numbers in `source` count from row `done`.
        /// A shared index takes back those that the server had not taken, if `source` is [`Error::WritesRefused`],
        /// [`Error::Closed`] or [`Error::Ended`]: they are among the unsent writes.
        done: usize,
        /// The number of rows to send.
        rows: usize,
        /// The ids under which an insert stored these rows, as far as their answers were read; none for rows that
        /// `min_separation` left out, and empty for other mutations.
        ids: Vec<u64>,
        /// The error of the next call; `OUT_OF_RANGE` if the client did not read the answer, which is above its limit.
        source: Box<Error>,
    },
    /// A file is not a snapshot, is damaged, or cannot be read.
    #[cfg(feature = "net")]
    #[error(transparent)]
    Snapshot(SnapshotError),
    /// A shared index no longer follows its server.
    #[error("the index is gone: {why}")]
    Ended {
        /// The reason.
        why: Arc<Error>,
    },
    /// The server's answer violates the protocol.
    #[error(
        "{call}: the answer breaks the protocol: {problem}; client and server may be of different versions"
    )]
    Protocol {
        /// The call.
        call: &'static str,
        /// The problem with the answer.
        problem: String,
    },
}

#[cfg(feature = "net")]
impl Error {
    /// The gRPC status code of the error, or the nearest one.
    pub fn code(&self) -> Code {
        match self {
            Error::Address { .. }
            | Error::Credential { .. }
            | Error::Width { .. }
            | Error::Layout { .. }
            | Error::State { .. }
            | Error::Argument { .. }
            | Error::NotInMemory { .. }
            | Error::Snapshot(_) => Code::InvalidArgument,
            Error::IdTaken { .. } => Code::AlreadyExists,
            Error::WritesRefused { why } | Error::Ended { why } => why.code(),
            Error::Closed | Error::Forked | Error::OtherSpace { .. } => Code::FailedPrecondition,
            Error::Interrupted => Code::Cancelled,
            Error::Thread { .. } | Error::Connection { .. } | Error::Handshake { .. } => {
                Code::Unavailable
            }
            Error::SearchTimeout | Error::Timeout { .. } => Code::DeadlineExceeded,
            Error::Refused(refusal) => refusal.code,
            Error::Partial { source, .. } => source.code(),
            Error::Protocol { .. } => Code::Internal,
        }
    }

    /// The server's reason in UPPER_SNAKE_CASE, if the server refused the call.
    pub fn reason(&self) -> Option<&str> {
        match self {
            Error::Refused(refusal) => Some(&refusal.reason),
            Error::Partial { source, .. } => source.reason(),
            Error::Ended { why } | Error::WritesRefused { why } => why.reason(),
            _ => None,
        }
    }

    /// The error of a call whose first attempt had no answer in time.
    pub(crate) fn timeout(call: &'static str, timeout: Duration) -> Error {
        Error::Timeout {
            call,
            timeout,
            earlier: None,
        }
    }

    /// The error of a call whose answer violates the protocol.
    pub(crate) fn protocol(call: &'static str, problem: impl Into<String>) -> Error {
        Error::Protocol {
            call,
            problem: problem.into(),
        }
    }

    /// True if the outcome of a mutation is unknown after this error: it may have taken effect.
    pub fn may_have_taken_effect(&self) -> bool {
        match self {
            Error::Timeout { .. } | Error::Interrupted | Error::Protocol { .. } => true,
            Error::Connection { source, .. } => !was_unsent(source.as_ref()),
            Error::Refused(refusal) => refusal.may_have_taken_effect(),
            Error::Partial { source, .. } => source.may_have_taken_effect(),
            Error::WritesRefused { why } | Error::Ended { why } => why.may_have_taken_effect(),
            _ => false,
        }
    }

    /// The error of an attempt that followed one with the error `earlier`, which explains more than a lack of time
    /// does, and after which a refusal may not mean that nothing was changed.
    pub(crate) fn following(self, earlier: Option<Error>) -> Error {
        match (self, earlier) {
            (Error::Timeout { call, timeout, .. }, earlier) => Error::Timeout {
                call,
                timeout,
                earlier: earlier.map(Box::new),
            },
            (Error::Refused(mut refusal), Some(earlier)) if earlier.may_have_taken_effect() => {
                refusal.earlier = Some(earlier.to_string());
                Error::Refused(refusal)
            }
            (other, Some(earlier))
                if earlier.may_have_taken_effect() && !other.may_have_taken_effect() =>
            {
                earlier
            }
            (other, _) => other,
        }
    }

    /// The error of a call that ended with `status`.
    pub(crate) fn from_status(
        call: &'static str,
        uri: &str,
        timeout: Duration,
        status: tonic::Status,
    ) -> Error {
        // A status from the server has no source; one that the transport made for a failure has.
        let made_here = std::error::Error::source(&status).is_some();
        match status.code() {
            // The transport gives up a little before or after the call does, and calls that a cancellation.
            Code::Cancelled if status.message() == TIMEOUT_EXPIRED => Error::timeout(call, timeout),
            _ if made_here => Error::Connection {
                call,
                uri: uri.to_owned(),
                source: Box::new(status),
            },
            _ => Error::Refused(Box::new(Refusal::from_status(&status))),
        }
    }

    /// A connection that the server ended with a TLS alert is a failed handshake: under TLS 1.3 the alert that refuses
    /// the client's certificate, or the lack of one, arrives at the first call.
    pub(crate) fn or_handshake(self) -> Error {
        match self {
            Error::Connection { uri, source, .. }
                if root_cause(&*source).starts_with(RECEIVED_ALERT) =>
            {
                let problem = root_cause(&*source);
                Error::Handshake { uri, problem }
            }
            other => other,
        }
    }

    /// True if the same call may succeed a little later.
    pub(crate) fn is_transient(&self) -> bool {
        let is_unavailable = matches!(self, Error::Connection { .. } | Error::Refused(_))
            && self.code() == Code::Unavailable;
        is_unavailable || self.retry_after().is_some()
    }

    /// The pause that the server asks for before the same call.
    pub(crate) fn retry_after(&self) -> Option<std::time::Duration> {
        match self {
            Error::Refused(refusal) => refusal.retry_after,
            _ => None,
        }
    }
}

/// True if a call had no connection on which it could be sent.
#[cfg(feature = "net")]
fn was_unsent(source: &(dyn std::error::Error + 'static)) -> bool {
    let mut causes = std::iter::successors(Some(source), |cause| cause.source());
    causes.any(|cause| cause.is::<tonic::ConnectError>())
}

/// The text of `tonic::TimeoutExpired`. A status keeps nothing else of that error.
#[cfg(feature = "net")]
const TIMEOUT_EXPIRED: &str = "Timeout expired";

/// The beginning of the text of `rustls::Error::AlertReceived`. HTTP/2 keeps nothing else of that error.
#[cfg(feature = "net")]
const RECEIVED_ALERT: &str = "received fatal alert: ";

fn earlier_attempt(earlier: Option<&Error>) -> String {
    let text = earlier.map(|error| format!("; a try before: {error}"));
    text.unwrap_or_default()
}

/// The innermost error: "Connection refused" says more than the "transport error" around it.
pub(crate) fn root_cause(error: &(dyn std::error::Error + 'static)) -> String {
    let mut cause = error;
    while let Some(source) = cause.source() {
        cause = source;
    }
    cause.to_string()
}

impl From<SearchError> for Error {
    fn from(error: SearchError) -> Error {
        match error {
            SearchError::State(error) => Error::State { row: 0, error },
            SearchError::TimedOut => Error::SearchTimeout,
            SearchError::Radius => Error::Argument {
                field: "radius",
                problem: "NaN".to_owned(),
            },
            SearchError::Epsilon(epsilon) => Error::Argument {
                field: "epsilon",
                problem: format!("{epsilon}; it is finite and at least 0"),
            },
        }
    }
}

impl From<ApplyError> for Error {
    fn from(error: ApplyError) -> Error {
        match error {
            ApplyError::Points(PointsError::State { row, error }) => Error::State { row, error },
            other => Error::Argument {
                field: "states",
                problem: other.to_string(),
            },
        }
    }
}

#[cfg(all(test, feature = "net"))]
mod tests {
    use std::sync::Arc;

    use tonic::Status;

    use super::*;

    #[test]
    fn a_failure_of_the_transport_is_no_refusal() {
        // A proxy that resets the stream with ENHANCE_YOUR_CALM.
        let mut reset = Status::resource_exhausted("h2 protocol error");
        let refusal = |status| Error::from_status("knn", "here", Duration::ZERO, status);
        assert!(!refusal(reset.clone()).is_transient());
        reset.set_source(Arc::new(std::fmt::Error));
        assert!(refusal(reset).is_transient());
    }
}
