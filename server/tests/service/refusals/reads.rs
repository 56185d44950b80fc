//! Searches, gets and scans that are refused.

use wayfold_proto::v1;

use super::{Fault, assert_elsewhere, assert_faults, assert_invalid};
use crate::support::*;

/// Points that changed after the first revision of the index with this uid.
fn since(uid: &str) -> Option<v1::Filter> {
    Some(v1::Filter {
        since_revision: revision(uid, 1),
        ..Default::default()
    })
}

const BAD_SEARCHES: [Fault<v1::KnnRequest>; 8] = [
    (|r| r.k_form = nearest(0).map(Into::into), "ZERO", "k"),
    (|r| r.radius_form = within(f64::NAN), "NAN", "radius"),
    (|r| r.radius_form = within(-1.0), "NEGATIVE", "radius"),
    (|r| r.epsilon = -1.0, "NEGATIVE", "epsilon"),
    (|r| r.epsilon = f64::INFINITY, "INFINITE", "epsilon"),
    (
        |r| {
            r.filter = Some(v1::Filter {
                tag_mask: 1,
                tag_value: 2,
                since_revision: None,
            });
        },
        "OUTSIDE_MASK",
        "filter.tag_value",
    ),
    (
        |r| r.filter = since(""),
        "REQUIRED",
        "filter.since_revision.uid",
    ),
    (
        |r| r.min_revision = revision("", 1),
        "REQUIRED",
        "min_revision.uid",
    ),
];

const BAD_QUERIES: [Fault<v1::QueryRequest>; 4] = [
    (|r| r.radius_form = within(-1.0), "NEGATIVE", "radius"),
    (|r| r.radius_form = within(f64::NAN), "NAN", "radius"),
    (|r| r.epsilon = f64::NAN, "NAN", "epsilon"),
    // A missing radius is not one of 0.
    (|r| r.radius_form = None, "REQUIRED", "radius"),
];

#[tokio::test]
async fn bad_reads() {
    let (service, uid) = arm("R3").await;
    insert_rows(&service, &[[0.0; 3]], &[]).await;
    let search = async |request| service.knn(&CALL, request).await;
    assert_faults(&knn(&[[0.0; 3]], 1), &BAD_SEARCHES, search).await;
    let query = v1::QueryRequest {
        index_name: "arm".into(),
        states: states(&[[0.0; 3]]),
        radius_form: within(1.0),
        ..Default::default()
    };
    let call = async |request| service.query(&CALL, request).await;
    assert_faults(&query, &BAD_QUERIES, call).await;
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
            ..knn(&[[0.0; 3]], 1)
        },
        v1::KnnRequest {
            filter: since("another"),
            ..knn(&[[0.0; 3]], 1)
        },
    ] {
        let unknown = v1::KnnRequest {
            index_name: "leg".into(),
            ..other.clone()
        };
        assert_elsewhere(search(other).await, search(unknown).await);
    }
    let right = v1::KnnRequest {
        min_revision: revision(&uid, 0),
        filter: since(&uid),
        ..knn(&[[0.0; 3]], 1)
    };
    assert!(search(right).await.is_ok());
}
