//! Inserts, updates and removals that are refused.

use bytes::Bytes;
use wayfold_proto::v1;
use wayfold_server::service::Error;

use super::{assert_elsewhere, assert_invalid, states::GOOD};
use crate::support::*;

#[tokio::test]
async fn bad_inserts() {
    let (service, _) = arm("R3*SO3:0.15").await;
    service
        .insert(&CALL, insertion(&[GOOD], &[]))
        .await
        .unwrap();
    let good = || insertion(&[GOOD, GOOD], &[]);
    let query = |k: Option<u32>, radius: Option<f64>| {
        Some(v1::NeighborSpec {
            k_form: k.and_then(nearest),
            radius_form: radius.and_then(within),
            ..Default::default()
        })
    };
    let filtered = |filter| {
        Some(v1::NeighborSpec {
            k_form: nearest(1),
            filter: Some(filter),
            ..Default::default()
        })
    };
    let cases = [
        (insertion(&[GOOD, GOOD], &[4, 4]), "DUPLICATE_ID", "ids[1]"),
        (
            insertion(&[GOOD, GOOD], &[4, 1 << 63]),
            "ID_TOO_LARGE",
            "ids[1]",
        ),
        (insertion(&[GOOD, GOOD], &[4]), "COUNT", "ids"),
        (
            v1::InsertRequest {
                tags: vec![1; 3],
                ..good()
            },
            "COUNT",
            "tags",
        ),
        (
            v1::InsertRequest {
                payloads: vec![Bytes::new()],
                ..good()
            },
            "COUNT",
            "payloads",
        ),
        (
            v1::InsertRequest {
                payloads: vec![Bytes::new(), vec![0; 65_537].into()],
                ..good()
            },
            "PAYLOAD_TOO_LARGE",
            "payloads[1]",
        ),
        (
            v1::InsertRequest {
                on_conflict: 9,
                ..good()
            },
            "UNKNOWN_VALUE",
            "on_conflict",
        ),
        (
            v1::InsertRequest {
                min_separation: -0.1,
                ..good()
            },
            "NEGATIVE",
            "min_separation",
        ),
        (
            v1::InsertRequest {
                min_separation: f64::NAN,
                ..good()
            },
            "NAN",
            "min_separation",
        ),
        (
            v1::InsertRequest {
                min_separation: f64::INFINITY,
                ..good()
            },
            "INFINITE",
            "min_separation",
        ),
        (
            v1::InsertRequest {
                neighbors: query(None, None),
                ..good()
            },
            "REQUIRED",
            "neighbors",
        ),
        (
            v1::InsertRequest {
                neighbors: query(Some(0), None),
                ..good()
            },
            "ZERO",
            "neighbors.k",
        ),
        (
            v1::InsertRequest {
                neighbors: query(None, Some(-1.0)),
                ..good()
            },
            "NEGATIVE",
            "neighbors.radius",
        ),
        (
            v1::InsertRequest {
                neighbors: filtered(v1::Filter {
                    since_revision: revision("", 1),
                    ..Default::default()
                }),
                ..good()
            },
            "REQUIRED",
            "neighbors.filter.since_revision.uid",
        ),
        (
            v1::InsertRequest {
                neighbors: filtered(v1::Filter {
                    tag_mask: 2,
                    tag_value: 3,
                    since_revision: None,
                }),
                ..good()
            },
            "OUTSIDE_MASK",
            "neighbors.filter.tag_value",
        ),
        (
            v1::InsertRequest {
                operation_id: "x".repeat(65),
                ..good()
            },
            "TOO_LONG",
            "operation_id",
        ),
    ];
    let before = everything(&service).await;
    for (request, reason, field) in cases {
        assert_invalid(service.insert(&CALL, request).await, reason, field);
    }
    let other = v1::InsertRequest {
        uid: "another".into(),
        ..good()
    };
    let unknown = v1::InsertRequest {
        index_name: "leg".into(),
        ..good()
    };
    assert_elsewhere(
        service.insert(&CALL, other).await,
        service.insert(&CALL, unknown).await,
    );
    assert_eq!(everything(&service).await, before);
}

#[tokio::test]
async fn the_first_few_of_many_violations_are_named() {
    let (service, _) = arm("R1").await;
    let error = service
        .insert(&CALL, insertion(&[[f64::NAN]; 100], &[]))
        .await
        .unwrap_err();
    let Error::InvalidArgument { violations } = &error else {
        panic!("{error}");
    };
    assert_eq!(violations.len(), 10);
    assert!(
        error
            .to_string()
            .starts_with("states[0].coords[0]: NaN; states[1].coords[0]: NaN; ")
    );
}

#[tokio::test]
async fn bad_updates_and_removals() {
    let (service, _) = arm("R1").await;
    service
        .insert(&CALL, insertion(&[[1.0], [2.0], [3.0]], &[]))
        .await
        .unwrap();
    let good = || v1::UpdateRequest {
        index_name: "arm".into(),
        ids: vec![0, 1, 2],
        ..Default::default()
    };
    let cases = [
        (
            v1::UpdateRequest {
                ids: vec![0, 0],
                ..good()
            },
            "DUPLICATE_ID",
            "ids[1]",
        ),
        (
            v1::UpdateRequest {
                tags: vec![1, 2],
                ..good()
            },
            "COUNT",
            "tags",
        ),
        (
            v1::UpdateRequest {
                payloads: vec![Bytes::new()],
                ..good()
            },
            "COUNT",
            "payloads",
        ),
        (
            v1::UpdateRequest {
                if_revision: revision("", 1),
                ..good()
            },
            "REQUIRED",
            "if_revision.uid",
        ),
        (
            v1::UpdateRequest {
                tag_mask: Some(1),
                ..good()
            },
            "REQUIRED",
            "tags",
        ),
        (
            v1::UpdateRequest {
                tags: vec![0b01, 0b01, 0b10],
                tag_mask: Some(0b01),
                ..good()
            },
            "OUTSIDE_MASK",
            "tags[2]",
        ),
        (
            v1::UpdateRequest {
                operation_id: "x".repeat(65),
                ..good()
            },
            "TOO_LONG",
            "operation_id",
        ),
    ];
    let before = everything(&service).await;
    for (request, reason, field) in cases {
        assert_invalid(service.update(&CALL, request).await, reason, field);
    }
    let other = v1::UpdateRequest {
        uid: "another".into(),
        ..good()
    };
    let unknown = v1::UpdateRequest {
        index_name: "leg".into(),
        ..good()
    };
    assert_elsewhere(
        service.update(&CALL, other).await,
        service.update(&CALL, unknown).await,
    );

    let twice = service.remove(&CALL, removal(&[1, 2, 1])).await;
    assert_invalid(twice, "DUPLICATE_ID", "ids[2]");
    let other = v1::RemoveRequest {
        uid: "another".into(),
        ..removal(&[1])
    };
    let unknown = v1::RemoveRequest {
        index_name: "leg".into(),
        ..removal(&[1])
    };
    assert_elsewhere(
        service.remove(&CALL, other).await,
        service.remove(&CALL, unknown).await,
    );
    assert_eq!(everything(&service).await, before);
}
