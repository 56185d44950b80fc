//! The outcome of an operation, in a form that can be compared.

use std::{collections::BTreeMap, fmt::Debug};

use prost::Message;
use serde_json::Value;
use tonic_types::pb;
use wayfold_proto::v1;
use wayfold_server::service::{Code, Error};

/// A placeholder for the uid of the index, which differs on each server.
pub(crate) const UID: &str = "11111111-2222-3333-4444-555555555555";

/// An answer, written so that every bit shows, or a refusal.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Outcome {
    Reply { text: String, revision: u64 },
    Refused(Box<Refused>),
}

/// A refusal, taken apart.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Refused {
    code: i32,
    reason: String,
    /// The fields and their reasons.
    fields: Vec<(String, String)>,
    /// The parts that the service's error lacks: the message and the other details.
    message: String,
    metadata: BTreeMap<String, String>,
    details: Vec<String>,
}

impl Outcome {
    pub(crate) fn answered(message: &impl Debug, revision: u64) -> Self {
        Outcome::Reply {
            text: format!("{message:?}"),
            revision,
        }
    }

    pub(crate) fn is_ok(&self) -> bool {
        matches!(self, Outcome::Reply { .. })
    }

    pub(crate) fn reason(&self) -> Option<String> {
        match self {
            Outcome::Reply { .. } => None,
            Outcome::Refused(refused) => Some(refused.reason.clone()),
        }
    }

    /// The part that the service itself also returns.
    pub(crate) fn core(&self) -> Self {
        match self {
            Outcome::Reply { .. } => self.clone(),
            Outcome::Refused(refused) => Outcome::Refused(Box::new(Refused {
                code: refused.code,
                reason: refused.reason.clone(),
                fields: refused.fields.clone(),
                ..Default::default()
            })),
        }
    }

    /// The same with `UID` for the uid.
    pub(crate) fn with_uid(self, uid: &str) -> Self {
        let replace = |text: &mut String| {
            if !uid.is_empty() {
                *text = text.replace(uid, UID);
            }
        };
        match self {
            Outcome::Reply { mut text, revision } => {
                replace(&mut text);
                Outcome::Reply { text, revision }
            }
            Outcome::Refused(mut refused) => {
                replace(&mut refused.message);
                refused.metadata.values_mut().for_each(replace);
                refused.details.iter_mut().for_each(replace);
                Outcome::Refused(refused)
            }
        }
    }
}

impl From<Error> for Outcome {
    fn from(error: Error) -> Self {
        let fields = match &error {
            // A status names the first 8.
            Error::InvalidArgument { violations } => violations
                .iter()
                .take(8)
                .map(|it| (it.field.clone(), it.reason.to_owned()))
                .collect(),
            Error::OperationMismatch { .. } => {
                vec![("operation_id".to_owned(), "OPERATION_MISMATCH".to_owned())]
            }
            Error::BatchMismatch { .. } => {
                vec![("batch".to_owned(), "BATCH_MISMATCH".to_owned())]
            }
            _ => Vec::new(),
        };
        Outcome::Refused(Box::new(Refused {
            code: number(error.code()),
            reason: error.reason().to_owned(),
            fields,
            ..Default::default()
        }))
    }
}

/// The codes as gRPC numbers them.
fn number(code: Code) -> i32 {
    match code {
        Code::InvalidArgument => 3,
        Code::DeadlineExceeded => 4,
        Code::NotFound => 5,
        Code::AlreadyExists => 6,
        Code::PermissionDenied => 7,
        Code::ResourceExhausted => 8,
        Code::FailedPrecondition => 9,
        Code::Internal => 13,
        Code::Unavailable => 14,
        Code::DataLoss => 15,
        Code::Unauthenticated => 16,
    }
}

impl From<tonic::Status> for Outcome {
    fn from(status: tonic::Status) -> Self {
        let details = pb::Status::decode(status.details()).unwrap().details;
        let details = details.iter().map(|any| (&*any.type_url, &*any.value));
        refused(status.code().into(), status.message(), details)
    }
}

impl From<v1::Status> for Outcome {
    fn from(status: v1::Status) -> Self {
        let details = status.details.iter();
        let details = details.map(|any| (&*any.type_url, &*any.value));
        refused(status.code, &status.message, details)
    }
}

fn refused<'a>(
    code: i32,
    message: &str,
    details: impl Iterator<Item = (&'a str, &'a [u8])>,
) -> Outcome {
    let mut refused = Refused {
        code,
        message: message.to_owned(),
        ..Default::default()
    };
    for (url, bytes) in details {
        match url.rsplit('.').next().unwrap() {
            "ErrorInfo" => {
                let info = pb::ErrorInfo::decode(bytes).unwrap();
                assert_eq!(info.domain, "wayfold");
                refused.reason = info.reason;
                refused.metadata = info.metadata.into_iter().collect();
            }
            "BadRequest" => {
                for it in pb::BadRequest::decode(bytes).unwrap().field_violations {
                    refused.details.push(it.description);
                    refused.fields.push((it.field, it.reason));
                }
            }
            "ResourceInfo" => {
                let it = pb::ResourceInfo::decode(bytes).unwrap();
                let texts = [it.resource_type, it.resource_name, it.owner, it.description];
                refused.details.extend(texts);
            }
            "PreconditionFailure" => {
                for it in pb::PreconditionFailure::decode(bytes).unwrap().violations {
                    refused
                        .details
                        .extend([it.r#type, it.subject, it.description]);
                }
            }
            "QuotaFailure" => {
                for it in pb::QuotaFailure::decode(bytes).unwrap().violations {
                    let value = it.quota_value.to_string();
                    refused.details.extend([it.subject, it.description, value]);
                }
            }
            other => panic!("a detail {other}"),
        }
    }
    Outcome::Refused(Box::new(refused))
}

/// A refusal in JSON.
pub(crate) fn refused_json(status: &Value) -> Outcome {
    let text = |value: &Value| value.as_str().unwrap().to_owned();
    let mut refused = Refused {
        code: i32::try_from(status["code"].as_i64().unwrap()).unwrap(),
        message: text(&status["message"]),
        ..Default::default()
    };
    for detail in status["details"].as_array().unwrap() {
        match text(&detail["@type"]).rsplit('.').next().unwrap() {
            "ErrorInfo" => {
                assert_eq!(detail["domain"], "wayfold");
                refused.reason = text(&detail["reason"]);
                let metadata = detail["metadata"].as_object().unwrap().iter();
                refused.metadata = metadata
                    .map(|(name, it)| (name.clone(), text(it)))
                    .collect();
            }
            "BadRequest" => {
                for it in detail["field_violations"].as_array().unwrap() {
                    refused.details.push(text(&it["description"]));
                    refused
                        .fields
                        .push((text(&it["field"]), text(&it["reason"])));
                }
            }
            "ResourceInfo" => {
                let names = ["resource_type", "resource_name", "owner", "description"];
                refused
                    .details
                    .extend(names.map(|name| text(&detail[name])));
            }
            "PreconditionFailure" => {
                for it in detail["violations"].as_array().unwrap() {
                    let names = ["type", "subject", "description"];
                    refused.details.extend(names.map(|name| text(&it[name])));
                }
            }
            "QuotaFailure" => {
                for it in detail["violations"].as_array().unwrap() {
                    let value = &it["quota_value"];
                    let value = value
                        .as_str()
                        .map_or_else(|| value.to_string(), str::to_owned);
                    let names = [&it["subject"], &it["description"]].map(text);
                    refused.details.extend(names);
                    refused.details.push(value);
                }
            }
            other => panic!("a detail {other}"),
        }
    }
    Outcome::Refused(Box::new(refused))
}
