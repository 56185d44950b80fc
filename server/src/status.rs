//! One error, one status: the service's errors as gRPC statuses with `google.rpc` details.

use std::collections::HashMap;

use prost::Message;
use tonic::{Code, Response, Status};
use tonic_types::{
    ErrorDetails, FieldViolation, PreconditionViolation, QuotaViolation, StatusExt, pb,
};
use tracing::error;
use wayfold_proto::v1;

use crate::service::{self, Error, Violation};

/// The domain of every `ErrorInfo`.
pub(crate) const DOMAIN: &str = "wayfold";

// A status travels in HTTP/2 headers, of which stock clients take 8 KiB in all, and its text goes twice. What a caller
// wrote may be of any length, so everything is bounded.
const MAX_MESSAGE: usize = 512;
const MAX_VIOLATIONS: usize = 8;
const MAX_TEXT: usize = 160;
const MAX_IDS: usize = 64;

/// The answer of a unary call.
pub(crate) fn respond<T>(result: Result<T, Error>) -> Result<Response<T>, Status> {
    result
        .map(Response::new)
        .map_err(|error| from_error(&error))
}

/// The status of a failed call.
pub(crate) fn from_error(error: &Error) -> Status {
    if matches!(
        error.code(),
        service::Code::Internal | service::Code::DataLoss
    ) {
        error!(%error, "call failed");
    }
    describing(error)
}

/// The same where no call failed.
pub(crate) fn describing(error: &Error) -> Status {
    let mut metadata = Metadata::default();
    let mut details = ErrorDetails::new();
    describe(error, &mut metadata, &mut details);
    details.set_error_info(error.reason(), DOMAIN, metadata.0);
    Status::with_error_details(code_of(error.code()), bounded(error, MAX_MESSAGE), details)
}

/// The status of a call that exceeds a limit of this face.
pub(crate) fn limit(reason: &str, message: String, limit: &str, value: usize) -> Status {
    let mut metadata = Metadata::default();
    metadata.set("limit", limit);
    metadata.set("value", value);
    let mut details = ErrorDetails::new();
    details.set_quota_failure([quota(limit, &message, value as u64)]);
    details.set_error_info(reason, DOMAIN, metadata.0);
    Status::with_error_details(Code::ResourceExhausted, message, details)
}

/// `status` as a message, for answers that carry it.
pub(crate) fn to_message(status: &Status) -> v1::Status {
    // The details are a google.rpc.Status that this file encoded.
    let details = pb::Status::decode(status.details()).map_or_else(|_| Vec::new(), |s| s.details);
    v1::Status {
        code: status.code().into(),
        message: status.message().to_owned(),
        details,
    }
}

/// A page of the indices, with a status for each that cannot be read.
pub(crate) fn listing(listing: service::Listing) -> v1::ListIndexesResponse {
    let damaged = listing.damaged.into_iter().map(|damaged| v1::DamagedIndex {
        error: Some(to_message(&describing(&damaged.error))),
        name: damaged.name,
        uid: damaged.uid,
    });
    v1::ListIndexesResponse {
        indexes: listing.indexes,
        next_page_token: listing.next_page_token,
        damaged: damaged.collect(),
    }
}

fn code_of(code: service::Code) -> Code {
    match code {
        service::Code::InvalidArgument => Code::InvalidArgument,
        service::Code::NotFound => Code::NotFound,
        service::Code::AlreadyExists => Code::AlreadyExists,
        service::Code::FailedPrecondition => Code::FailedPrecondition,
        service::Code::ResourceExhausted => Code::ResourceExhausted,
        service::Code::Unavailable => Code::Unavailable,
        service::Code::DeadlineExceeded => Code::DeadlineExceeded,
        service::Code::Unauthenticated => Code::Unauthenticated,
        service::Code::PermissionDenied => Code::PermissionDenied,
        service::Code::DataLoss => Code::DataLoss,
        service::Code::Internal => Code::Internal,
    }
}

fn describe(error: &Error, metadata: &mut Metadata, details: &mut ErrorDetails) {
    match error {
        Error::InvalidArgument { violations } => {
            let shown = violations.iter().take(MAX_VIOLATIONS).map(field_violation);
            details.set_bad_request(shown.collect::<Vec<_>>());
        }
        Error::OperationMismatch { operation_id } => {
            metadata.set("operation_id", operation_id);
            details.set_bad_request([field_violation(&Violation {
                field: "operation_id".to_owned(),
                reason: error.reason(),
                description: error.to_string(),
            })]);
        }
        Error::IndexNotFound { name } | Error::NameTaken { name } => {
            resource(details, "wayfold.v1.Index", name, error);
        }
        Error::PointsNotFound { index, ids } | Error::PointsExist { index, ids } => {
            metadata.set("index", index);
            metadata.set_ids(ids);
            let name = ids.first().map_or(String::new(), |id| id.to_string());
            resource(details, "wayfold.v1.Point", &name, error);
        }
        Error::IndexExists {
            name,
            existing,
            asked,
        } => {
            metadata.set("existing", existing);
            metadata.set("asked", asked);
            resource(details, "wayfold.v1.Index", name, error);
        }
        Error::UidMismatch {
            index,
            asked,
            found,
        } => {
            metadata.set("index", index);
            metadata.set("asked", asked);
            metadata.set("found", found);
            precondition(details, index, error);
        }
        Error::RevisionConflict {
            index,
            if_revision,
            ids,
        } => {
            metadata.set("index", index);
            metadata.set("if_revision", if_revision);
            metadata.set_ids(ids);
            precondition(details, index, error);
        }
        Error::LimitExceeded {
            limit,
            value,
            asked,
            advice: _,
        } => {
            metadata.set("limit", limit);
            metadata.set("value", value);
            metadata.set("asked", asked);
            let violation = quota(limit, &bounded(error, MAX_TEXT), *value);
            details.set_quota_failure([violation]);
        }
        Error::IdsExhausted { index } => {
            metadata.set("index", index);
            details.set_quota_failure([quota("ids", &bounded(error, MAX_TEXT), 1 << 63)]);
        }
        Error::ScanTooLong {
            scan_seconds,
            after_id,
        } => {
            metadata.set("limit", "scan_seconds");
            metadata.set("value", scan_seconds);
            if let Some(id) = after_id {
                metadata.set("after_id", id);
            }
            let text = bounded(error, MAX_TEXT);
            details.set_quota_failure([quota("scan_seconds", &text, *scan_seconds)]);
        }
        Error::HeldTooLong {
            what: _,
            scan_seconds,
        } => {
            metadata.set("limit", "scan_seconds");
            metadata.set("value", scan_seconds);
            let text = bounded(error, MAX_TEXT);
            details.set_quota_failure([quota("scan_seconds", &text, *scan_seconds)]);
        }
        Error::Unavailable { why: _ }
        | Error::DeadlineExceeded { doing: _ }
        | Error::StorageFailed { what: _ }
        | Error::DataLoss { what: _ }
        | Error::Internal { what: _ } => {}
    }
}

fn field_violation(violation: &Violation) -> FieldViolation {
    let mut shown = FieldViolation::new(
        bounded(&violation.field, MAX_TEXT),
        bounded(&violation.description, MAX_TEXT),
    );
    shown.reason = violation.reason.to_owned();
    shown
}

fn resource(details: &mut ErrorDetails, kind: &str, name: &str, error: &Error) {
    details.set_resource_info(kind, bounded(name, MAX_TEXT), "", bounded(error, MAX_TEXT));
}

fn precondition(details: &mut ErrorDetails, index: &str, error: &Error) {
    details.set_precondition_failure([PreconditionViolation::new(
        error.reason(),
        bounded(index, MAX_TEXT),
        bounded(error, MAX_TEXT),
    )]);
}

fn quota(subject: &str, description: &str, value: u64) -> QuotaViolation {
    let mut violation = QuotaViolation::new(subject, description);
    violation.quota_value = i64::try_from(value).unwrap_or(i64::MAX);
    violation
}

/// The metadata of an `ErrorInfo`.
#[derive(Default)]
struct Metadata(HashMap<String, String>);

impl Metadata {
    fn set(&mut self, key: &str, value: impl ToString) {
        self.0.insert(key.to_owned(), bounded(value, MAX_TEXT));
    }

    /// The first of `ids`, separated by commas, and how many there are.
    fn set_ids(&mut self, ids: &[u64]) {
        let shown: Vec<String> = ids.iter().take(MAX_IDS).map(u64::to_string).collect();
        self.0.insert("ids".to_owned(), shown.join(","));
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
mod tests {
    use std::collections::BTreeSet;

    use super::*;
    use crate::service::Unavailability;

    /// One error of every kind, the code it must have on the wire, and the kind of detail it must carry.
    fn every_error() -> Vec<(Error, Code, Option<&'static str>)> {
        let (index, ids) = ("arm".to_owned(), vec![3, 5]);
        let violation = Violation {
            field: "states[37].coords[3]".into(),
            reason: "NAN",
            description: "NaN".into(),
        };
        vec![
            (
                Error::InvalidArgument {
                    violations: vec![violation],
                },
                Code::InvalidArgument,
                Some("BadRequest"),
            ),
            (
                Error::OperationMismatch {
                    operation_id: "op".into(),
                },
                Code::InvalidArgument,
                Some("BadRequest"),
            ),
            (
                Error::IndexNotFound {
                    name: index.clone(),
                },
                Code::NotFound,
                Some("ResourceInfo"),
            ),
            (
                Error::PointsNotFound {
                    index: index.clone(),
                    ids: ids.clone(),
                },
                Code::NotFound,
                Some("ResourceInfo"),
            ),
            (
                Error::IndexExists {
                    name: index.clone(),
                    existing: "R3".into(),
                    asked: "SO2".into(),
                },
                Code::AlreadyExists,
                Some("ResourceInfo"),
            ),
            (
                Error::NameTaken {
                    name: index.clone(),
                },
                Code::AlreadyExists,
                Some("ResourceInfo"),
            ),
            (
                Error::HeldTooLong {
                    what: "snapshot",
                    scan_seconds: 300,
                },
                Code::ResourceExhausted,
                Some("QuotaFailure"),
            ),
            (
                Error::PointsExist {
                    index: index.clone(),
                    ids: ids.clone(),
                },
                Code::AlreadyExists,
                Some("ResourceInfo"),
            ),
            (
                Error::UidMismatch {
                    index: index.clone(),
                    asked: "a".into(),
                    found: "b".into(),
                },
                Code::FailedPrecondition,
                Some("PreconditionFailure"),
            ),
            (
                Error::RevisionConflict {
                    index: index.clone(),
                    if_revision: 7,
                    ids,
                },
                Code::FailedPrecondition,
                Some("PreconditionFailure"),
            ),
            (
                Error::LimitExceeded {
                    limit: "k",
                    value: 10,
                    asked: 11,
                    advice: "ask for fewer",
                },
                Code::ResourceExhausted,
                Some("QuotaFailure"),
            ),
            (
                Error::IdsExhausted { index },
                Code::ResourceExhausted,
                Some("QuotaFailure"),
            ),
            (
                Error::ScanTooLong {
                    scan_seconds: 300,
                    after_id: Some(9),
                },
                Code::ResourceExhausted,
                Some("QuotaFailure"),
            ),
            (
                Error::Unavailable {
                    why: Unavailability::Starting,
                },
                Code::Unavailable,
                None,
            ),
            (
                Error::DeadlineExceeded {
                    doing: "while searching",
                },
                Code::DeadlineExceeded,
                None,
            ),
            (
                Error::DataLoss {
                    what: "a record is damaged".into(),
                },
                Code::DataLoss,
                None,
            ),
            (
                Error::Internal {
                    what: "an invariant".into(),
                },
                Code::Internal,
                None,
            ),
        ]
    }

    #[test]
    fn every_error_has_its_code_and_details() {
        for (error, code, detail) in every_error() {
            let status = from_error(&error);
            assert_eq!(status.code(), code, "{error:?}");
            assert_eq!(status.message(), error.to_string());
            let info = status.get_details_error_info().unwrap();
            assert_eq!((&*info.domain, &*info.reason), (DOMAIN, error.reason()));
            let message = to_message(&status);
            assert_eq!(message.code, i32::from(code));
            assert_eq!(message.message, status.message());
            let kinds: BTreeSet<&str> = message
                .details
                .iter()
                .filter_map(|any| any.type_url.strip_prefix("type.googleapis.com/google.rpc."))
                .collect();
            let expected: BTreeSet<&str> = ["ErrorInfo"].into_iter().chain(detail).collect();
            assert_eq!(kinds, expected, "{error:?}");
        }
    }

    #[test]
    fn fields_ids_and_limits_can_be_read_by_a_program() {
        let violation = Violation {
            field: "states[37].coords[3]".into(),
            reason: "NAN",
            description: "not a number".into(),
        };
        let status = from_error(&Error::InvalidArgument {
            violations: vec![violation],
        });
        let fields = status.get_details_bad_request().unwrap().field_violations;
        assert_eq!(fields[0].field, "states[37].coords[3]");
        assert_eq!(fields[0].reason, "NAN");

        let status = from_error(&Error::PointsExist {
            index: "arm".into(),
            ids: (0..100).collect(),
        });
        let metadata = status.get_details_error_info().unwrap().metadata;
        assert!(metadata["ids"].starts_with("0,1,2,"));
        assert_eq!(metadata["ids_total"], "100");

        let status = from_error(&Error::LimitExceeded {
            limit: "k",
            value: 10,
            asked: 11,
            advice: "ask for fewer",
        });
        let violations = status.get_details_quota_failure().unwrap().violations;
        assert_eq!(violations[0].subject, "k");
        assert_eq!(violations[0].quota_value, 10);
    }

    #[test]
    fn a_status_fits_into_headers_whatever_the_caller_wrote() {
        let long = "ü".repeat(100_000);
        let violation = Violation {
            field: long.clone(),
            reason: "NAN",
            description: long.clone(),
        };
        for error in [
            Error::IndexNotFound { name: long.clone() },
            Error::InvalidArgument {
                violations: vec![violation; 100],
            },
            Error::RevisionConflict {
                index: long.clone(),
                if_revision: u64::MAX,
                ids: vec![u64::MAX; 100_000],
            },
            Error::IndexExists {
                name: long.clone(),
                existing: long.clone(),
                asked: long.clone(),
            },
        ] {
            let mut headers = http::HeaderMap::new();
            from_error(&error).add_header(&mut headers).unwrap();
            let bytes: usize = headers
                .iter()
                .map(|(name, value)| name.as_str().len() + value.len() + 32)
                .sum();
            assert!(bytes < 8 * 1024, "{bytes} bytes");
        }
    }
}
