//! An error as a line of JSON.

use std::collections::BTreeMap;

use serde::Serialize;
use wayfold::{Error, Refusal};

use super::Failure;
use crate::output::JsonIds;

/// `{"error":{"code":...,"reason":...,"message":...}}`.
#[derive(Serialize)]
pub(crate) struct ErrorLine<'a> {
    error: Body<'a>,
}

/// `code` is the name of a gRPC status, `reason` is for programs to match on, `message` is for people. The rest are
/// the details of a server's refusal, where it gave any.
#[derive(Serialize)]
struct Body<'a> {
    code: &'a str,
    reason: &'a str,
    message: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    metadata: Option<&'a BTreeMap<String, String>>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    fields: Vec<Field<'a>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    ids: Option<JsonIds<'a>>,
}

#[derive(Serialize)]
struct Field<'a> {
    field: &'a str,
    problem: &'a str,
}

impl<'a> ErrorLine<'a> {
    pub(crate) fn of(failure: &'a Failure) -> ErrorLine<'a> {
        let (code, reason) = code_and_reason(failure);
        let refusal = client_error(failure).and_then(refusal);
        ErrorLine {
            error: Body {
                code,
                reason,
                message: failure.to_string(),
                metadata: refusal
                    .map(|refusal| &refusal.metadata)
                    .filter(|metadata| !metadata.is_empty()),
                fields: refusal.map(fields).unwrap_or_default(),
                ids: refusal
                    .map(|refusal| &refusal.ids[..])
                    .filter(|ids| !ids.is_empty())
                    .map(JsonIds),
            },
        }
    }
}

/// The line of a wrong command line.
pub(crate) fn usage_line(message: &str) -> ErrorLine<'static> {
    ErrorLine {
        error: Body {
            code: "INVALID_ARGUMENT",
            reason: "USAGE",
            message: message.to_owned(),
            metadata: None,
            fields: Vec::new(),
            ids: None,
        },
    }
}

fn fields(refusal: &Refusal) -> Vec<Field<'_>> {
    let fields = refusal.fields.iter().map(|violation| Field {
        field: &violation.field,
        problem: &violation.problem,
    });
    fields.collect()
}

/// The error of the library that a failure is made of.
fn client_error(failure: &Failure) -> Option<&Error> {
    match failure {
        Failure::Client(source)
        | Failure::Replaceable { source }
        | Failure::Late { source, .. } => Some(source),
        Failure::Stopped { source, .. } => client_error(source),
        _ => None,
    }
}

fn refusal(error: &Error) -> Option<&Refusal> {
    match error {
        Error::Refused(refusal) => Some(refusal),
        Error::Partial { source, .. } => refusal(source),
        Error::WritesRefused { why } | Error::Ended { why } => refusal(why),
        _ => None,
    }
}

fn code_and_reason(failure: &Failure) -> (&str, &str) {
    match failure {
        Failure::Client(source)
        | Failure::Replaceable { source }
        | Failure::Handshake { source }
        | Failure::Late { source, .. } => of_client(source),
        Failure::Stopped { source, .. } => code_and_reason(source),
        Failure::Load(error) => error.code_and_reason(),
        Failure::Input(_) => ("INVALID_ARGUMENT", "INPUT"),
        Failure::Snapshot { .. } => ("INVALID_ARGUMENT", "SNAPSHOT"),
        Failure::Credential { .. } => ("INVALID_ARGUMENT", "CREDENTIAL"),
        Failure::HalfCertificate { .. } | Failure::NoServer => ("INVALID_ARGUMENT", "USAGE"),
        Failure::Random(_) => ("UNAVAILABLE", "RANDOM"),
        Failure::Terminal => ("INVALID_ARGUMENT", "TERMINAL"),
        Failure::Output(_) => ("UNKNOWN", "OUTPUT"),
        Failure::File { .. } => ("UNKNOWN", "FILE"),
        Failure::Exists { .. } => ("ALREADY_EXISTS", "FILE_EXISTS"),
        Failure::NoFile { .. } => ("FAILED_PRECONDITION", "NOT_A_FILE"),
        Failure::Interrupted => ("CANCELLED", "INTERRUPTED"),
        Failure::Disagreement { .. } => ("DATA_LOSS", "DISAGREEMENT"),
        Failure::Damaged { .. } => ("DATA_LOSS", "DAMAGED_INDEX"),
        Failure::NotServing { .. } => ("UNAVAILABLE", "NOT_SERVING"),
        Failure::Reset { reason, .. } => ("FAILED_PRECONDITION", reason),
        Failure::Runtime(_) => ("INTERNAL", "RUNTIME"),
        Failure::Unreachable { .. } => ("UNAVAILABLE", "UNREACHABLE"),
    }
}

/// The code and reason of the server's refusal; errors of the library have reasons of their own.
fn of_client(error: &Error) -> (&str, &str) {
    match error {
        Error::Refused(refusal) => (refusal.code_name(), &refusal.reason),
        Error::Partial { source, .. } => of_client(source),
        Error::WritesRefused { why } | Error::Ended { why } => of_client(why),
        Error::Address { .. } => ("INVALID_ARGUMENT", "ADDRESS"),
        Error::Width { .. } | Error::Layout { .. } | Error::Argument { .. } => {
            ("INVALID_ARGUMENT", "ARGUMENT")
        }
        Error::Snapshot(_) => ("INVALID_ARGUMENT", "SNAPSHOT"),
        Error::Connection { .. } => ("UNAVAILABLE", "UNREACHABLE"),
        Error::Handshake { .. } => ("UNAVAILABLE", "HANDSHAKE"),
        Error::Timeout { .. } => ("DEADLINE_EXCEEDED", "TIMEOUT"),
        Error::Protocol { .. } => ("INTERNAL", "PROTOCOL"),
        // Other errors of a shared index, which `load` opens.
        _ => ("UNKNOWN", "UNKNOWN"),
    }
}
