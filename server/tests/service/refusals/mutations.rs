//! Inserts, updates and removals that are refused.

use bytes::Bytes;
use wayfold_proto::v1;
use wayfold_server::service::{Error, Service};

use super::{Fault, assert_elsewhere, assert_faults, assert_invalid, states::GOOD};
use crate::support::*;

/// A service with three points, which no refused call changes.
async fn three_points() -> (Service, v1::ScanResponse) {
    let (service, _) = arm("R3*SO3:0.15").await;
    let insert = insertion(&[GOOD; 3], &[]);
    service.insert(&CALL, insert).await.unwrap();
    let before = everything(&service).await;
    (service, before)
}

/// Neighbours by a filter.
fn filtered(filter: v1::Filter) -> Option<v1::NeighborSpec> {
    Some(v1::NeighborSpec {
        k_form: nearest(1),
        filter: Some(filter),
        ..Default::default()
    })
}

const BAD_INSERTS: [Fault<v1::InsertRequest>; 16] = [
    (|r| r.ids = vec![4, 4], "DUPLICATE_ID", "ids[1]"),
    (|r| r.ids = vec![4, 1 << 63], "ID_TOO_LARGE", "ids[1]"),
    (|r| r.ids = vec![4], "COUNT", "ids"),
    (|r| r.tags = vec![1; 3], "COUNT", "tags"),
    (|r| r.payloads = vec![Bytes::new()], "COUNT", "payloads"),
    (
        |r| r.payloads = vec![Bytes::new(), vec![0; 65_537].into()],
        "PAYLOAD_TOO_LARGE",
        "payloads[1]",
    ),
    (|r| r.on_conflict = 9, "UNKNOWN_VALUE", "on_conflict"),
    (|r| r.min_separation = -0.1, "NEGATIVE", "min_separation"),
    (|r| r.min_separation = f64::NAN, "NAN", "min_separation"),
    (
        |r| r.min_separation = f64::INFINITY,
        "INFINITE",
        "min_separation",
    ),
    (
        |r| r.neighbor_spec = Some(v1::NeighborSpec::default()),
        "REQUIRED",
        "neighbor_spec",
    ),
    (
        |r| {
            r.neighbor_spec = Some(v1::NeighborSpec {
                k_form: nearest(0),
                ..Default::default()
            });
        },
        "ZERO",
        "neighbor_spec.k",
    ),
    (
        |r| {
            r.neighbor_spec = Some(v1::NeighborSpec {
                radius_form: within(-1.0),
                ..Default::default()
            });
        },
        "NEGATIVE",
        "neighbor_spec.radius",
    ),
    (
        |r| {
            r.neighbor_spec = filtered(v1::Filter {
                since_revision: revision("", 1),
                ..Default::default()
            });
        },
        "REQUIRED",
        "neighbor_spec.filter.since_revision.uid",
    ),
    (
        |r| {
            r.neighbor_spec = filtered(v1::Filter {
                tag_mask: 2,
                tag_value: 3,
                since_revision: None,
            });
        },
        "OUTSIDE_MASK",
        "neighbor_spec.filter.tag_value",
    ),
    (
        |r| r.operation_id = "x".repeat(65),
        "TOO_LONG",
        "operation_id",
    ),
];

const BAD_UPDATES: [Fault<v1::UpdateRequest>; 7] = [
    (|r| r.ids = vec![0, 0], "DUPLICATE_ID", "ids[1]"),
    (|r| r.tags = vec![1, 2], "COUNT", "tags"),
    (|r| r.payloads = vec![Bytes::new()], "COUNT", "payloads"),
    (
        |r| r.if_revision = revision("", 1),
        "REQUIRED",
        "if_revision.uid",
    ),
    (|r| r.tag_mask = Some(1), "REQUIRED", "tags"),
    (
        |r| (r.tags, r.tag_mask) = (vec![0b01, 0b01, 0b10], Some(0b01)),
        "OUTSIDE_MASK",
        "tags[2]",
    ),
    (
        |r| r.operation_id = "x".repeat(65),
        "TOO_LONG",
        "operation_id",
    ),
];

#[tokio::test]
async fn bad_inserts() {
    let (service, before) = three_points().await;
    let good = insertion(&[GOOD, GOOD], &[]);
    let insert = async |request| service.insert(&CALL, request).await;
    assert_faults(&good, &BAD_INSERTS, insert).await;
    let other = v1::InsertRequest {
        uid: "another".into(),
        ..good.clone()
    };
    let unknown = v1::InsertRequest {
        index_name: "leg".into(),
        ..good
    };
    assert_elsewhere(insert(other).await, insert(unknown).await);
    assert_eq!(everything(&service).await, before);
}

#[tokio::test]
async fn the_first_few_of_many_violations_are_named() {
    let (service, _) = arm("R1").await;
    let insert = insertion(&[[f64::NAN]; 100], &[]);
    let error = service.insert(&CALL, insert).await.unwrap_err();
    let Error::InvalidArgument { violations } = &error else {
        panic!("{error}");
    };
    assert_eq!(violations.len(), 10);
    let start = "states[0].coords[0]: NaN; states[1].coords[0]: NaN; ";
    assert!(error.to_string().starts_with(start));
}

#[tokio::test]
async fn bad_updates() {
    let (service, before) = three_points().await;
    let good = updating(&[0, 1, 2]);
    let update = async |request| service.update(&CALL, request).await;
    assert_faults(&good, &BAD_UPDATES, update).await;
    let other = v1::UpdateRequest {
        uid: "another".into(),
        ..good.clone()
    };
    let unknown = v1::UpdateRequest {
        index_name: "leg".into(),
        ..good
    };
    assert_elsewhere(update(other).await, update(unknown).await);
    assert_eq!(everything(&service).await, before);
}

#[tokio::test]
async fn bad_removals() {
    let (service, before) = three_points().await;
    let remove = async |request| service.remove(&CALL, request).await;
    assert_invalid(remove(removal(&[1, 2, 1])).await, "DUPLICATE_ID", "ids[2]");
    let other = v1::RemoveRequest {
        uid: "another".into(),
        ..removal(&[1])
    };
    let unknown = v1::RemoveRequest {
        index_name: "leg".into(),
        ..removal(&[1])
    };
    assert_elsewhere(remove(other).await, remove(unknown).await);
    assert_eq!(everything(&service).await, before);
}

#[tokio::test]
async fn bad_operation_of_a_removal() {
    let (service, _) = three_points().await;
    let long = v1::RemoveRequest {
        operation_id: "x".repeat(65),
        ..removal(&[1])
    };
    assert_invalid(
        service.remove(&CALL, long).await,
        "TOO_LONG",
        "operation_id",
    );
}
