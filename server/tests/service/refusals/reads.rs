//! Searches, gets and scans that are refused.

use wayfold_proto::v1;

use super::{assert_elsewhere, assert_invalid};
use crate::support::*;

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
            v1::KnnRequest {
                radius_form: within(f64::NAN),
                ..good()
            },
            "NAN",
            "radius",
        ),
        (
            v1::KnnRequest {
                radius_form: within(-1.0),
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
        assert_invalid(service.knn(&CALL, request).await, reason, field);
    }
    let query = |radius, epsilon| v1::QueryRequest {
        index_name: "arm".into(),
        states: states(&[[0.0; 3]]),
        radius_form: within(radius),
        epsilon,
        ..Default::default()
    };
    for (request, reason, field) in [
        (query(-1.0, 0.0), "NEGATIVE", "radius"),
        (query(f64::NAN, 0.0), "NAN", "radius"),
        (query(1.0, f64::NAN), "NAN", "epsilon"),
        // A radius that was forgotten is not one of 0.
        (
            v1::QueryRequest {
                radius_form: None,
                ..query(1.0, 0.0)
            },
            "REQUIRED",
            "radius",
        ),
    ] {
        assert_invalid(service.query(&CALL, request).await, reason, field);
    }
    let twice = service.get(&CALL, getting(&[1, 1])).await;
    assert_invalid(twice, "DUPLICATE_ID", "ids[1]");
    let scan = v1::ScanRequest {
        filter: since(""),
        ..scanning()
    };
    let refused = service.scan(&CALL, scan).await.map(drop);
    assert_invalid(refused, "REQUIRED", "filter.since_revision.uid");
    let unknown = v1::ScanRequest {
        index_name: "leg".into(),
        ..scanning()
    };
    let refused = service.scan(&CALL, unknown).await.map(drop);
    assert_eq!(refusal(refused).1, "INDEX_NOT_FOUND");
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
        let unknown = v1::KnnRequest {
            index_name: "leg".into(),
            ..other.clone()
        };
        assert_elsewhere(
            service.knn(&CALL, other).await,
            service.knn(&CALL, unknown).await,
        );
    }
    let right = v1::KnnRequest {
        min_revision: revision(&uid, 0),
        filter: since(&uid),
        ..good()
    };
    assert!(service.knn(&CALL, right).await.is_ok());
}
