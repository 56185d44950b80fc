//! Every kind of bad input has its code, its reason and its field, and leaves the index as it was.

use bytes::Bytes;
use wayfold_proto::v1;
use wayfold_server::service::{Code, Error};

use crate::support::*;

fn invalid(reason: &'static str, field: &str) -> (Code, &'static str, String) {
    (Code::InvalidArgument, reason, field.into())
}

const GOOD: [f64; 7] = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0];

fn with(at: usize, value: f64) -> v1::InsertRequest {
    let mut bad = GOOD;
    bad[at] = value;
    insertion(&[GOOD, bad], &[])
}

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
            count: k.and_then(nearest),
            reach: radius.and_then(within),
            ..Default::default()
        })
    };
    let filtered = |filter| {
        Some(v1::NeighborSpec {
            count: nearest(1),
            filter: Some(filter),
            ..Default::default()
        })
    };
    let mut narrow = good();
    narrow.states.as_mut().unwrap().coordinates.pop();
    let mut rows = good();
    rows.states.as_mut().unwrap().rows = 3;
    let mut missing = good();
    missing.states = None;
    let cases = [
        (with(1, f64::NAN), "NAN", "states[1].coords[1]"),
        (with(0, f64::INFINITY), "INFINITE", "states[1].coords[0]"),
        (with(2, 1e151), "TOO_LARGE", "states[1].coords[2]"),
        (with(6, 1.1), "NORM", "states[1].coords[3]"),
        (narrow, "WIDTH", "states.coordinates"),
        (rows, "WIDTH", "states.coordinates"),
        (missing, "REQUIRED", "states"),
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
        let refused = refusal(service.insert(&CALL, request).await);
        assert_eq!(refused, invalid(reason, field));
    }
    let other = v1::InsertRequest {
        uid: "another".into(),
        ..good()
    };
    assert_eq!(
        refusal(service.insert(&CALL, other).await).1,
        "UID_MISMATCH"
    );
    let unknown = v1::InsertRequest {
        index: "leg".into(),
        ..good()
    };
    assert_eq!(
        refusal(service.insert(&CALL, unknown).await).1,
        "INDEX_NOT_FOUND"
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
async fn bad_reads() {
    let (service, uid) = arm("R3").await;
    service
        .insert(&CALL, insertion(&[[0.0; 3]], &[]))
        .await
        .unwrap();
    let good = || knn(&[[0.0; 3]], 1);
    let masked = v1::Filter {
        tag_mask: 1,
        tag_value: 2,
        since_revision: None,
    };
    let since = |uid| {
        Some(v1::Filter {
            since_revision: revision(uid, 1),
            ..Default::default()
        })
    };
    let cases = [
        (knn(&[[0.0; 3]], 0), "ZERO", "k"),
        (
            knn(&[[0.0, f64::NAN, 0.0]], 1),
            "NAN",
            "states[0].coords[1]",
        ),
        (knn(&[[0.0; 2]], 1), "WIDTH", "states.coordinates"),
        (
            v1::KnnRequest {
                reach: within(f64::NAN),
                ..good()
            },
            "NAN",
            "radius",
        ),
        (
            v1::KnnRequest {
                reach: within(-1.0),
                ..good()
            },
            "NEGATIVE",
            "radius",
        ),
        (
            v1::KnnRequest {
                epsilon: -1.0,
                ..good()
            },
            "NEGATIVE",
            "epsilon",
        ),
        (
            v1::KnnRequest {
                epsilon: f64::INFINITY,
                ..good()
            },
            "INFINITE",
            "epsilon",
        ),
        (
            v1::KnnRequest {
                filter: Some(masked),
                ..good()
            },
            "OUTSIDE_MASK",
            "filter.tag_value",
        ),
        (
            v1::KnnRequest {
                filter: since(""),
                ..good()
            },
            "REQUIRED",
            "filter.since_revision.uid",
        ),
        (
            v1::KnnRequest {
                min_revision: revision("", 1),
                ..good()
            },
            "REQUIRED",
            "min_revision.uid",
        ),
    ];
    for (request, reason, field) in cases {
        let refused = refusal(service.knn(&CALL, request).await);
        assert_eq!(refused, invalid(reason, field));
    }
    let query = |radius, epsilon| v1::QueryRequest {
        index: "arm".into(),
        states: states(&[[0.0; 3]]),
        reach: within(radius),
        epsilon,
        ..Default::default()
    };
    assert_eq!(
        refusal(service.query(&CALL, query(-1.0, 0.0)).await),
        invalid("NEGATIVE", "radius")
    );
    assert_eq!(
        refusal(service.query(&CALL, query(1.0, f64::NAN)).await),
        invalid("NAN", "epsilon")
    );
    // A radius that was forgotten is not one of 0.
    let forgotten = v1::QueryRequest {
        reach: None,
        ..query(1.0, 0.0)
    };
    assert_eq!(
        refusal(service.query(&CALL, forgotten).await),
        invalid("REQUIRED", "radius")
    );
    assert_eq!(
        refusal(service.get(&CALL, getting(&[1, 1])).await),
        invalid("DUPLICATE_ID", "ids[1]")
    );
    let scan = v1::ScanRequest {
        filter: since(""),
        ..scanning()
    };
    let refused = service.scan(&CALL, scan).await.map(|_| ());
    let field = "filter.since_revision.uid";
    assert_eq!(refusal(refused), invalid("REQUIRED", field));
    for other in [
        v1::KnnRequest {
            min_revision: revision("another", 0),
            ..good()
        },
        v1::KnnRequest {
            filter: since("another"),
            ..good()
        },
    ] {
        assert_eq!(refusal(service.knn(&CALL, other).await).1, "UID_MISMATCH");
    }
    let right = v1::KnnRequest {
        min_revision: revision(&uid, 0),
        filter: since(&uid),
        ..good()
    };
    assert!(service.knn(&CALL, right).await.is_ok());
}

#[tokio::test]
async fn bad_updates_and_removals() {
    let (service, _) = arm("R1").await;
    service
        .insert(&CALL, insertion(&[[1.0], [2.0], [3.0]], &[]))
        .await
        .unwrap();
    let good = || v1::UpdateRequest {
        index: "arm".into(),
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
    for (request, reason, field) in cases {
        let refused = refusal(service.update(&CALL, request).await);
        assert_eq!(refused, invalid(reason, field));
    }
    let twice = refusal(service.remove(&CALL, removal(&[2, 2])).await);
    assert_eq!(twice, invalid("DUPLICATE_ID", "ids[1]"));
    assert_eq!(info(&service, "arm").await.revision.number(), 1);
}
