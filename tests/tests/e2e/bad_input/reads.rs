//! Bad fields of the calls that read points.

use tonic::Code::{self, FailedPrecondition, InvalidArgument, NotFound};
use wayfold_proto::v1::{
    Filter, GetRequest, KnnRequest, QueryRequest, ScanRequest, knn_request, knn_request::Count,
    query_request,
};
use wayfold_tests::{revision, row_states};

use super::{Bench, INDEX, good_row};

type Expected = (Code, &'static str, &'static str);

#[tokio::test]
async fn bad_reads_are_refused() {
    let bench = Bench::new().await;
    let mut stub = bench.stubs.points.clone();
    let good = || KnnRequest {
        index: INDEX.into(),
        states: Some(row_states(&good_row(), 7)),
        count: Some(Count::K(1)),
        ..Default::default()
    };
    let filtered = |tag_mask, tag_value, since_revision| {
        Some(Filter {
            tag_mask,
            tag_value,
            since_revision,
        })
    };
    let bad = |reason, field| (InvalidArgument, reason, field);
    let cases: Vec<(&str, KnnRequest, Expected)> = vec![
        (
            "an unknown index",
            KnnRequest {
                index: "nowhere".into(),
                ..good()
            },
            (NotFound, "INDEX_NOT_FOUND", ""),
        ),
        (
            "k = 0",
            KnnRequest {
                count: Some(Count::K(0)),
                ..good()
            },
            bad("ZERO", "k"),
        ),
        (
            "a negative radius",
            KnnRequest {
                reach: Some(knn_request::Reach::Radius(-1.0)),
                ..good()
            },
            bad("NEGATIVE", "radius"),
        ),
        (
            "a radius that is not a number",
            KnnRequest {
                reach: Some(knn_request::Reach::Radius(f64::NAN)),
                ..good()
            },
            bad("NAN", "radius"),
        ),
        (
            "a negative epsilon",
            KnnRequest {
                epsilon: -0.5,
                ..good()
            },
            bad("NEGATIVE", "epsilon"),
        ),
        (
            "an infinite epsilon",
            KnnRequest {
                epsilon: f64::INFINITY,
                ..good()
            },
            bad("INFINITE", "epsilon"),
        ),
        (
            "a tag outside its mask",
            KnnRequest {
                filter: filtered(1, 2, None),
                ..good()
            },
            bad("OUTSIDE_MASK", "filter.tag_value"),
        ),
        (
            "a revision to start from without its uid",
            KnnRequest {
                filter: filtered(0, 0, revision("", 1)),
                ..good()
            },
            bad("REQUIRED", "filter.since_revision.uid"),
        ),
        (
            "a revision to wait for without its uid",
            KnnRequest {
                min_revision: revision("", 1),
                ..good()
            },
            bad("REQUIRED", "min_revision.uid"),
        ),
        (
            "another uid",
            KnnRequest {
                min_revision: revision("another", 0),
                ..good()
            },
            (FailedPrecondition, "UID_MISMATCH", ""),
        ),
        (
            "a revision of another uid to start from",
            KnnRequest {
                filter: filtered(0, 0, revision("another", 1)),
                ..good()
            },
            (FailedPrecondition, "UID_MISMATCH", ""),
        ),
    ];
    for (what, request, expected) in cases {
        let answer = stub.knn(request).await;
        bench.refused(what, answer, expected).await;
    }

    let query = |radius| QueryRequest {
        index: INDEX.into(),
        states: good().states,
        reach: Some(query_request::Reach::Radius(radius)),
        ..Default::default()
    };
    let answer = stub.query(query(-1.0)).await;
    bench
        .refused("a negative radius", answer, bad("NEGATIVE", "radius"))
        .await;
    let answer = stub.query(query(f64::NAN)).await;
    bench
        .refused("no radius", answer, bad("NAN", "radius"))
        .await;

    let get = |ids: &[u64]| GetRequest {
        index: INDEX.into(),
        ids: ids.to_vec(),
        ..Default::default()
    };
    let answer = stub.get(get(&[1, 77, 2, 88])).await;
    let refusal = bench
        .refused("missing points", answer, (NotFound, "POINTS_NOT_FOUND", ""))
        .await;
    assert!(refusal.message.contains("77, 88"), "{}", refusal.message);
    let answer = stub.get(get(&[1, 1])).await;
    bench
        .refused("an id twice", answer, bad("DUPLICATE_ID", "ids[1]"))
        .await;

    let scan = ScanRequest {
        index: "nowhere".into(),
        ..Default::default()
    };
    let answer = stub.scan(scan).await;
    bench
        .refused(
            "an unknown index",
            answer,
            (NotFound, "INDEX_NOT_FOUND", ""),
        )
        .await;
}
