//! Refusals that this face makes before the service is called, and tonic's refusals rewritten.
//!
//! Tonic answers a message above the size limit with OUT_OF_RANGE and one that does not parse with INTERNAL, both
//! without details. The contract says RESOURCE_EXHAUSTED with the limit, and INVALID_ARGUMENT; INTERNAL is a bug.

use std::{fmt::Display, time::Duration};

use http::{HeaderMap, Response};
use tonic::{Code, Status, body::Body};

use super::{
    connections::{MAX_ARRIVING, MAX_REFLECTING, MAX_WATCHING},
    deadline::{self, MalformedTimeout},
};
use crate::{
    request_bounds::{MAX_INDEX_REQUEST_BYTES, SMALL_SPACE},
    service::{Error, Unavailability, Violation},
    status::{Status as Refusal, busy, from_error, limit},
};

const MAX_MESSAGE_BYTES: &str = "grpc.max_message_bytes";
const MAX_INDEX_REQUEST: &str = "index_request_bytes";
const ARRIVING: &str = "arriving_requests";
const WATCHING: &str = "health_watches";
const MAX_CONNECTIONS: &str = "grpc.max_connections";
const MAX_CALLS: &str = "grpc.max_calls_per_connection";
const RECEIVE_TIMEOUT_MS: &str = "grpc.receive_timeout_ms";

/// The remedy for a message that is too large.
pub(crate) const SPLIT: &str = "split it into several calls";

/// The remedy if that message is a part of a snapshot.
pub(crate) const RAISE: &str =
    "a part of a snapshot has up to about 400 KiB and cannot be divided, so raise the limit";

/// Every status of this server has details: one without them is tonic's own.
const DETAILS_HEADER: &str = "grpc-status-details-bin";

/// The largest request message of a call.
#[derive(Clone, Copy, Debug)]
pub(crate) struct MessageLimit {
    name: &'static str,
    pub(crate) bytes: usize,
}

impl MessageLimit {
    /// The setting.
    pub(crate) fn of_setting(bytes: usize) -> Self {
        let name = MAX_MESSAGE_BYTES;
        Self { name, bytes }
    }

    /// The limit of a call on indices: at most [`MAX_INDEX_REQUEST_BYTES`], except for the parts of a snapshot.
    pub(crate) fn for_indices(self) -> Self {
        match self.bytes > MAX_INDEX_REQUEST_BYTES {
            true => Self {
                name: MAX_INDEX_REQUEST,
                bytes: MAX_INDEX_REQUEST_BYTES,
            },
            false => self,
        }
    }
}

/// Returns `response`, rewritten if it is a refusal of tonic's.
pub(crate) fn rewrite(response: Response<Body>, limit: MessageLimit) -> Response<Body> {
    match tonics_own(response.headers()) {
        Some(status) => restate(status, limit, SPLIT).into_http(),
        None => response,
    }
}

/// A refusal by tonic comes before any message of the answer, so its status is in the headers.
fn tonics_own(headers: &HeaderMap) -> Option<Status> {
    headers.get(Status::GRPC_STATUS)?;
    if headers.contains_key(DETAILS_HEADER) {
        return None;
    }
    Status::from_header_map(headers)
}

/// The contract's status for one that tonic made while it read a request; `advice` is for one that is too large.
pub(crate) fn restate(status: Status, limit: MessageLimit, advice: &str) -> Status {
    match status.code() {
        Code::OutOfRange => too_large(limit, advice).into(),
        Code::Internal => malformed(status.message()).into(),
        _ => status,
    }
}

/// Our own refusal of a request, or the end of a call whose client cut it: that is no fault of the server.
pub(crate) fn unless_left(status: Status) -> Status {
    match status.details().is_empty() {
        true => Status::cancelled("the request was cut"),
        false => status,
    }
}

/// The headers of a refusal.
pub(crate) fn headers(refusal: Refusal) -> HeaderMap {
    let (parts, _) = Status::from(refusal).into_http::<Body>().into_parts();
    parts.headers
}

/// The refusal of a request message above the limit.
pub(crate) fn too_large(MessageLimit { name, bytes }: MessageLimit, advice: &str) -> Refusal {
    let advice = match name {
        MAX_INDEX_REQUEST => SMALL_SPACE,
        _ => advice,
    };
    let message = format!("the request message exceeds the limit {name} = {bytes}: {advice}");
    limit("LIMIT_EXCEEDED", message, name, bytes)
}

/// The refusal of a request message that does not decode.
pub(crate) fn malformed(problem: impl Display) -> Refusal {
    invalid(
        "request",
        "MALFORMED_MESSAGE",
        format!("the message cannot be read: {problem}"),
    )
}

/// The refusal of a `grpc-timeout` header.
pub(crate) fn malformed_timeout(problem: &MalformedTimeout) -> Refusal {
    invalid(deadline::HEADER, "MALFORMED_TIMEOUT", problem.to_string())
}

/// The refusal of a request with one wrong field.
pub(crate) fn invalid(field: &str, reason: &'static str, description: String) -> Refusal {
    from_error(&Error::InvalidArgument {
        violations: vec![Violation {
            field: field.to_owned(),
            reason,
            description,
        }],
    })
}

/// The refusal of a request that did not arrive in time.
pub(crate) fn too_slow(time: Duration) -> Refusal {
    let most = time.as_millis() as usize;
    let message = format!(
        "the request, or the next message of a stream, did not arrive within {RECEIVE_TIMEOUT_MS} = {most}: send smaller \
         messages"
    );
    busy("TOO_SLOW", message, RECEIVE_TIMEOUT_MS, most)
}

/// The refusal of a stream that would leave too few of the `max_calls` of its connection to calls that end.
pub(crate) fn too_many_streams(max_calls: u32) -> Refusal {
    let message = format!(
        "Watch and StreamKnn of this connection have three quarters of {MAX_CALLS} = {max_calls}: open another \
         connection, or raise the setting"
    );
    busy("TOO_MANY_CALLS", message, MAX_CALLS, max_calls as usize)
}

/// The refusal of a call of a guest.
pub(crate) fn too_many_connections(limit: usize) -> Refusal {
    let message = format!(
        "others have all {MAX_CONNECTIONS} = {limit}: until one ends, this one can ask for health, and list, create and \
         delete indices"
    );
    busy("TOO_MANY_CALLS", message, MAX_CONNECTIONS, limit)
}

/// The refusal of a request for health or reflection while others of its connection, or of all, have the places.
pub(crate) fn too_many_arriving() -> Refusal {
    let message = format!(
        "this connection has {MAX_ARRIVING} streams for reflection and requests for health that have not arrived \
         whole, or all have {MAX_REFLECTING} streams for reflection: end one, or call again later"
    );
    busy("TOO_MANY_CALLS", message, ARRIVING, MAX_ARRIVING)
}

/// The refusal of a watch of health while others of its connection have the places.
pub(crate) fn too_many_watching() -> Refusal {
    let message = format!("this connection has {MAX_WATCHING} watches of health: end one");
    busy("TOO_MANY_CALLS", message, WATCHING, MAX_WATCHING)
}

/// The refusal of the rest of a stream for reflection whose client sends faster than it is answered, or reads no answers.
pub(crate) fn too_many_waiting(max_bytes: usize) -> Refusal {
    let message = format!(
        "more than {max_bytes} bytes of the requests of this stream wait for answers: read these before you send more"
    );
    busy("TOO_MANY_CALLS", message, ARRIVING, max_bytes)
}

/// The end of a stream at the server's shutdown.
pub(crate) fn stopping() -> Refusal {
    from_error(&Error::Unavailable {
        why: Unavailability::Stopping,
    })
}

#[cfg(test)]
mod tests {
    use tonic_types::StatusExt;

    use super::*;
    use crate::faces::panicked;

    fn rewritten(status: Status) -> Status {
        let response = rewrite(status.into_http(), MessageLimit::of_setting(1000));
        Status::from_header_map(response.headers()).unwrap()
    }

    #[test]
    fn tonics_refusals_are_restated() {
        let large = rewritten(Status::out_of_range("decoded message length too large"));
        assert_eq!(large.code(), Code::ResourceExhausted);
        assert!(
            large.message().contains("grpc.max_message_bytes = 1000"),
            "{large}"
        );
        let violations = large.get_details_quota_failure().unwrap().violations;
        assert_eq!(violations[0].quota_value, 1000);

        let malformed = rewritten(Status::internal("invalid wire type"));
        assert_eq!(malformed.code(), Code::InvalidArgument);
        assert!(malformed.message().ends_with("invalid wire type"));
        let info = malformed.get_details_error_info().unwrap();
        assert_eq!(info.reason, "MALFORMED_MESSAGE");
    }

    #[test]
    fn our_own_statuses_and_successes_pass_unchanged() {
        let bug = rewritten(panicked("PointService/Knn").into());
        assert_eq!(bug.code(), Code::Internal);
        assert_eq!(bug.get_details_error_info().unwrap().reason, "INTERNAL");

        let unimplemented = rewritten(Status::unimplemented("no such method"));
        assert_eq!(unimplemented.code(), Code::Unimplemented);

        let mut success = Response::new(Body::empty());
        let kept = http::HeaderValue::from_static("yes");
        success.headers_mut().insert("x-kept", kept);
        let rewritten = rewrite(success, MessageLimit::of_setting(1000));
        assert!(rewritten.headers().contains_key("x-kept"));
    }
}
