//! A status as a message, with details of google.rpc. `tonic_types` has these as messages without a transport, and all faces
//! send them.

use prost::Message;
use prost_types::Any;
use tonic_types::pb;
use wayfold_proto::v1;

use super::{DOMAIN, Detail, MAX_TEXT_BYTES, Status, bounded};
use crate::service::Violation;

/// The descriptors of the details, the messages of google.rpc.
pub(crate) const DETAIL_DESCRIPTORS: &[u8] = pb::FILE_DESCRIPTOR_SET;

impl Status {
    /// The status as a message.
    pub(crate) fn to_message(&self) -> v1::Status {
        if let Some(given) = &self.given {
            return given.clone();
        }
        let info = pb::ErrorInfo {
            reason: self.reason.to_owned(),
            domain: DOMAIN.to_owned(),
            metadata: self.metadata.clone(),
        };
        let mut details = vec![any("ErrorInfo", &info)];
        details.extend(self.detail.as_ref().map(|detail| self.encoded(detail)));
        details.extend(self.retry_delay.map(|delay| {
            let retry_delay = prost_types::Duration::try_from(delay).ok();
            any("RetryInfo", &pb::RetryInfo { retry_delay })
        }));
        v1::Status {
            code: self.code.number(),
            message: self.message.clone(),
            details,
        }
    }

    fn encoded(&self, detail: &Detail) -> Any {
        let description = bounded(&self.message, MAX_TEXT_BYTES);
        match detail {
            Detail::Fields(violations) => {
                let field_violations = violations.iter().map(field_violation).collect();
                any("BadRequest", &pb::BadRequest { field_violations })
            }
            Detail::Resource(kind, name) => {
                let resource = pb::ResourceInfo {
                    resource_type: (*kind).to_owned(),
                    resource_name: bounded(name, MAX_TEXT_BYTES),
                    owner: String::new(),
                    description,
                };
                any("ResourceInfo", &resource)
            }
            Detail::Precondition(index) => {
                let violation = pb::precondition_failure::Violation {
                    r#type: self.reason.to_owned(),
                    subject: bounded(index, MAX_TEXT_BYTES),
                    description,
                };
                let violations = vec![violation];
                any(
                    "PreconditionFailure",
                    &pb::PreconditionFailure { violations },
                )
            }
            Detail::Quota(limit, value) => {
                let violation = pb::quota_failure::Violation {
                    subject: (*limit).to_owned(),
                    description,
                    quota_value: i64::try_from(*value).unwrap_or(i64::MAX),
                    ..Default::default()
                };
                let violations = vec![violation];
                any("QuotaFailure", &pb::QuotaFailure { violations })
            }
        }
    }
}

fn field_violation(violation: &Violation) -> pb::bad_request::FieldViolation {
    pb::bad_request::FieldViolation {
        field: bounded(&violation.field, MAX_TEXT_BYTES),
        description: bounded(&violation.description, MAX_TEXT_BYTES),
        reason: violation.reason.to_owned(),
        ..Default::default()
    }
}

/// A message of google.rpc as a detail.
fn any(name: &str, message: &impl Message) -> Any {
    Any {
        type_url: format!("type.googleapis.com/google.rpc.{name}"),
        value: message.encode_to_vec(),
    }
}
