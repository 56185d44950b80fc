//! The details that a server gives about a call that it refused.

use std::{collections::BTreeMap, fmt, time::Duration};

use tonic::Code;
use tonic_types::StatusExt;
use wayfold_proto::v1;

/// A call that the server refused, with the details it gave.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub struct Refusal {
    /// The gRPC status code.
    pub code: Code,
    /// The problem, its place and the remedy.
    pub message: String,
    /// The reason in UPPER_SNAKE_CASE, to match on; empty if the server gave none.
    pub reason: String,
    /// The values that the reason is about, such as limits, ids and revisions, by their names.
    pub metadata: BTreeMap<String, String>,
    /// The fields of the request that were wrong.
    pub fields: Vec<FieldViolation>,
    /// The ids that the refusal is about: those not found, or those in conflict. The server may cut a long list short.
    pub ids: Vec<u64>,
    /// The time after which the same call may succeed; `None` if the refusal is final.
    pub retry_after: Option<Duration>,
    /// The error of an earlier try of the same call after which its outcome is unknown, if there was one: the call may have
    /// taken effect then.
    pub earlier: Option<String>,
}

/// One field of a request, and what was wrong with it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FieldViolation {
    /// Its path in the request, as `states[37].coords[3]`.
    pub field: String,
    /// The problem with the field, such as `NaN`.
    pub problem: String,
}

impl Refusal {
    pub(crate) fn from_status(status: &tonic::Status) -> Refusal {
        let details = status.get_error_details();
        let info = details.error_info();
        let metadata: BTreeMap<_, _> = info
            .map(|info| info.metadata.clone().into_iter().collect())
            .unwrap_or_default();
        let fields = details.bad_request().map(|request| {
            let fields = request.field_violations.iter();
            let fields = fields.map(|violation| FieldViolation {
                field: violation.field.clone(),
                problem: violation.description.clone(),
            });
            fields.collect()
        });
        Refusal {
            code: status.code(),
            message: status.message().to_owned(),
            reason: info.map(|info| info.reason.clone()).unwrap_or_default(),
            ids: metadata
                .get("ids")
                .map(|ids| parse_ids(ids))
                .unwrap_or_default(),
            metadata,
            retry_after: details
                .retry_info()
                .map(|retry| retry.retry_delay.unwrap_or_default()),
            fields: fields.unwrap_or_default(),
            earlier: None,
        }
    }

    /// The refusal of one request on a stream. It has the same content as the status of a call.
    pub(crate) fn from_message(status: &v1::Status) -> Refusal {
        // The message equals a google.rpc.Status field for field, and that is the encoding of a status's details.
        let details = prost::Message::encode_to_vec(status).into();
        let code = Code::from_i32(status.code);
        Self::from_status(&tonic::Status::with_details(
            code,
            status.message.clone(),
            details,
        ))
    }
}

fn parse_ids(ids: &str) -> Vec<u64> {
    ids.split(',')
        .filter_map(|id| id.trim().parse().ok())
        .collect()
}

impl std::error::Error for Refusal {}

impl fmt::Display for Refusal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.message.as_str() {
            "" => f.write_str("refused without a message")?,
            message => f.write_str(message)?,
        }
        for FieldViolation { field, problem } in &self.fields {
            if !self.message.contains(field.as_str()) {
                write!(f, "; {field}: {problem}")?;
            }
        }
        write!(f, " ({})", self.code_name())?;
        match &self.earlier {
            Some(earlier) => write!(f, "; a try before: {earlier}"),
            None => Ok(()),
        }
    }
}

impl Refusal {
    /// True if the outcome of a mutation is unknown after it.
    pub(crate) fn may_have_taken_effect(&self) -> bool {
        let is_unknown = matches!(
            self.code,
            Code::DeadlineExceeded
                | Code::DataLoss
                | Code::Internal
                | Code::Cancelled
                | Code::Unknown
        );
        is_unknown || self.reason == "STORAGE_FAILED" || self.earlier.is_some()
    }

    /// The code's name as the gRPC documentation spells it.
    pub fn code_name(&self) -> &'static str {
        match self.code {
            Code::Ok => "OK",
            Code::Cancelled => "CANCELLED",
            Code::Unknown => "UNKNOWN",
            Code::InvalidArgument => "INVALID_ARGUMENT",
            Code::DeadlineExceeded => "DEADLINE_EXCEEDED",
            Code::NotFound => "NOT_FOUND",
            Code::AlreadyExists => "ALREADY_EXISTS",
            Code::PermissionDenied => "PERMISSION_DENIED",
            Code::ResourceExhausted => "RESOURCE_EXHAUSTED",
            Code::FailedPrecondition => "FAILED_PRECONDITION",
            Code::Aborted => "ABORTED",
            Code::OutOfRange => "OUT_OF_RANGE",
            Code::Unimplemented => "UNIMPLEMENTED",
            Code::Internal => "INTERNAL",
            Code::Unavailable => "UNAVAILABLE",
            Code::DataLoss => "DATA_LOSS",
            Code::Unauthenticated => "UNAUTHENTICATED",
        }
    }
}
