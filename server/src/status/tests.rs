//! Each error has its code, reason and details, and none outgrows the headers.

use std::collections::BTreeSet;

use prost::Message;
use prost_types::Any;
use tonic_types::pb;

use super::*;
use crate::{
    service::Unavailability,
    watermark::{Resource, WatermarkExceeded},
};

/// A message of google.rpc among the details of a status.
fn decoded<M: Message + Default>(status: &Status, name: &str) -> M {
    let details = status.to_message().details;
    let is_asked = |any: &&Any| any.type_url.ends_with(&format!("google.rpc.{name}"));
    let found = details.iter().find(is_asked).expect(name);
    M::decode(&*found.value).unwrap()
}

fn full(resource: Resource) -> WatermarkExceeded {
    WatermarkExceeded {
        resource,
        used: 90,
        high: 85,
        low: 80,
        limit: 100,
    }
}

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
                what: "space",
                existing: "R3".into(),
                requested: "SO2".into(),
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
                max_scan_seconds: 300,
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
                requested: "a".into(),
                found: "b".into(),
            },
            Code::FailedPrecondition,
            Some("PreconditionFailure"),
        ),
        (
            Error::UidUnknown {
                index: index.clone(),
                requested: "a".into(),
            },
            Code::Unavailable,
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
                limit: "max_k",
                value: 10,
                requested: 11,
                advice: "ask for fewer",
            },
            Code::ResourceExhausted,
            Some("QuotaFailure"),
        ),
        (
            Error::QuotaExceeded {
                index: index.clone(),
                limit: "max_points_per_index",
                value: 30,
                requested: 31,
            },
            Code::ResourceExhausted,
            Some("QuotaFailure"),
        ),
        (
            Error::NotLoaded {
                index: index.clone(),
                points: 30,
                needed: 300,
                full: full(Resource::Memory),
            },
            Code::Unavailable,
            Some("QuotaFailure"),
        ),
        (
            Error::IdsExhausted { index },
            Code::ResourceExhausted,
            Some("QuotaFailure"),
        ),
        (
            Error::ScanTooLong {
                max_scan_seconds: 300,
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
        assert_eq!(status.code, code, "{error:?}");
        assert_eq!(status.message, error.to_string());
        let info: pb::ErrorInfo = decoded(&status, "ErrorInfo");
        assert_eq!((&*info.domain, &*info.reason), (DOMAIN, error.reason()));
        let message = status.to_message();
        assert_eq!(message.code, code.number());
        assert_eq!(message.message, status.message);
        let kinds: BTreeSet<&str> = message
            .details
            .iter()
            .filter_map(|any| any.type_url.strip_prefix("type.googleapis.com/google.rpc."))
            .collect();
        let expected: BTreeSet<&str> = ["ErrorInfo"].into_iter().chain(detail).collect();
        assert_eq!(kinds, expected, "{error:?}");
        match detail {
            Some("ResourceInfo") => {
                let resource: pb::ResourceInfo = decoded(&status, "ResourceInfo");
                let name = match &*resource.resource_type {
                    "wayfold.v1.Point" => "3",
                    _ => "arm",
                };
                assert_eq!(resource.resource_name, name, "{error:?}");
            }
            Some("PreconditionFailure") => {
                let failure: pb::PreconditionFailure = decoded(&status, "PreconditionFailure");
                let violation = &failure.violations[0];
                assert_eq!(violation.r#type, error.reason());
                assert_eq!(violation.subject, "arm");
            }
            _ => {}
        }
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
    let fields = decoded::<pb::BadRequest>(&status, "BadRequest").field_violations;
    assert_eq!(fields[0].field, "states[37].coords[3]");
    assert_eq!(fields[0].reason, "NAN");

    let status = from_error(&Error::PointsExist {
        index: "arm".into(),
        ids: (0..100).collect(),
    });
    let metadata = decoded::<pb::ErrorInfo>(&status, "ErrorInfo").metadata;
    assert_eq!(metadata["index"], "arm");
    assert!(metadata["ids"].starts_with("0,1,2,"));
    assert_eq!(metadata["ids_total"], "100");

    let status = from_error(&Error::UidMismatch {
        index: "arm".into(),
        requested: "a".into(),
        found: "b".into(),
    });
    let metadata = decoded::<pb::ErrorInfo>(&status, "ErrorInfo").metadata;
    assert_eq!((&*metadata["requested"], &*metadata["found"]), ("a", "b"));

    let status = from_error(&Error::LimitExceeded {
        limit: "max_k",
        value: 10,
        requested: 11,
        advice: "ask for fewer",
    });
    let violations = decoded::<pb::QuotaFailure>(&status, "QuotaFailure").violations;
    assert_eq!(violations[0].subject, "max_k");
    assert_eq!(violations[0].quota_value, 10);
    let metadata = decoded::<pb::ErrorInfo>(&status, "ErrorInfo").metadata;
    assert_eq!((&*metadata["value"], &*metadata["requested"]), ("10", "11"));
}

#[test]
fn only_a_limit_that_passes_says_when_to_come_back() {
    for (limit, passes) in [("max_held_scans", true), ("max_k", false)] {
        let status = from_error(&Error::LimitExceeded {
            limit,
            value: 10,
            requested: 11,
            advice: "",
        });
        assert_eq!(status.retry_delay.is_some(), passes, "{limit}");
    }
}

#[test]
fn a_full_server_says_when_to_come_back_and_names_its_watermark() {
    for (resource, reason, setting) in [
        (Resource::Memory, "MEMORY_FULL", "memory.high_percent"),
        (Resource::Disk, "DISK_FULL", "disk.min_free_bytes"),
    ] {
        let full = full(resource);
        let status = from_error(&Error::Full { full });
        assert_eq!(
            (status.code, status.reason),
            (Code::ResourceExhausted, reason)
        );
        let retry: pb::RetryInfo = decoded(&status, "RetryInfo");
        assert_eq!(retry.retry_delay.unwrap().seconds, 1);
        let violations = decoded::<pb::QuotaFailure>(&status, "QuotaFailure").violations;
        assert_eq!(violations[0].subject, setting);
        assert_eq!(violations[0].quota_value, 85);
        let metadata = decoded::<pb::ErrorInfo>(&status, "ErrorInfo").metadata;
        assert_eq!(metadata["used"], "90");
    }
}

#[test]
fn an_answer_for_which_there_is_no_room_is_refused_as_a_call_is() {
    let error = Error::from(crate::admission::TooManyBytes(4096));
    let status = from_error(&error);
    assert_eq!(status, too_many_bytes(4096));
    assert_eq!(
        (status.code, status.reason),
        (Code::ResourceExhausted, "TOO_MANY_BYTES")
    );
    let retry: pb::RetryInfo = decoded(&status, "RetryInfo");
    assert!(retry.retry_delay.is_some());
    let violations = decoded::<pb::QuotaFailure>(&status, "QuotaFailure").violations;
    assert_eq!(violations[0].subject, "admission.max_bytes");
    assert_eq!(violations[0].quota_value, 4096);
}

#[test]
fn an_identity_with_too_many_calls_is_told_when_to_come_back() {
    let why = Denial::Unknown(IdentificationError::TooManyCalls(2));
    let status = from_error(&Error::Denied { why });
    let retry: pb::RetryInfo = decoded(&status, "RetryInfo");
    assert!(retry.retry_delay.is_some());
}
