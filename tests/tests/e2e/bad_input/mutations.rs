//! Bad fields of the calls that change points.

use tonic::Code::{self, AlreadyExists, FailedPrecondition, InvalidArgument, NotFound};
use wayfold_proto::v1::{InsertRequest, NeighborSpec, RemoveRequest, UpdateRequest, neighbor_spec};
use wayfold_tests::{k_nearest, number, revision, row_states};

use super::{Bench, INDEX, good_row};

type Expected = (Code, &'static str, &'static str);

#[tokio::test]
async fn bad_inserts_are_refused_whole() {
    let bench = Bench::new().await;
    let good = || InsertRequest {
        index: INDEX.into(),
        states: Some(row_states(&[good_row(), good_row()].concat(), 7)),
        ids: vec![10, 11],
        ..Default::default()
    };
    let near = |spec: NeighborSpec| InsertRequest {
        neighbors: Some(spec),
        ..good()
    };
    let bad = |reason, field| (InvalidArgument, reason, field);
    let cases: Vec<(&str, InsertRequest, Expected)> = vec![
        (
            "an unknown index",
            InsertRequest {
                index: "nowhere".into(),
                ..good()
            },
            (NotFound, "INDEX_NOT_FOUND", ""),
        ),
        (
            "another uid",
            InsertRequest {
                uid: "another".into(),
                ..good()
            },
            (FailedPrecondition, "UID_MISMATCH", ""),
        ),
        (
            "an id twice",
            InsertRequest {
                ids: vec![10, 10],
                ..good()
            },
            bad("DUPLICATE_ID", "ids[1]"),
        ),
        (
            "an id of 2^63",
            InsertRequest {
                ids: vec![10, 1 << 63],
                ..good()
            },
            bad("ID_TOO_LARGE", "ids[1]"),
        ),
        (
            "an id for one of two rows",
            InsertRequest {
                ids: vec![10],
                ..good()
            },
            bad("COUNT", "ids"),
        ),
        (
            "three tags for two rows",
            InsertRequest {
                tags: vec![1, 2, 3],
                ..good()
            },
            bad("COUNT", "tags"),
        ),
        (
            "a payload for one of two rows",
            InsertRequest {
                payloads: vec!["a".into()],
                ..good()
            },
            bad("COUNT", "payloads"),
        ),
        (
            "a payload above 64 KiB",
            InsertRequest {
                payloads: vec!["".into(), vec![0; 64 * 1024 + 1].into()],
                ..good()
            },
            bad("PAYLOAD_TOO_LARGE", "payloads[1]"),
        ),
        (
            "a negative separation",
            InsertRequest {
                min_separation: -0.1,
                ..good()
            },
            bad("NEGATIVE", "min_separation"),
        ),
        (
            "a separation that is not a number",
            InsertRequest {
                min_separation: f64::NAN,
                ..good()
            },
            bad("NAN", "min_separation"),
        ),
        (
            "an infinite separation",
            InsertRequest {
                min_separation: f64::INFINITY,
                ..good()
            },
            bad("INFINITE", "min_separation"),
        ),
        (
            "neighbours by nothing",
            near(NeighborSpec::default()),
            bad("REQUIRED", "neighbors"),
        ),
        (
            "no neighbour",
            near(k_nearest(0)),
            bad("ZERO", "neighbors.k"),
        ),
        (
            "neighbours within less than nothing",
            near(NeighborSpec {
                reach: Some(neighbor_spec::Reach::Radius(-1.0)),
                ..Default::default()
            }),
            bad("NEGATIVE", "neighbors.radius"),
        ),
        (
            "a long operation id",
            InsertRequest {
                operation_id: "x".repeat(65),
                ..good()
            },
            bad("TOO_LONG", "operation_id"),
        ),
        (
            "an unknown way with conflicts",
            InsertRequest {
                on_conflict: 7,
                ..good()
            },
            bad("UNKNOWN_VALUE", "on_conflict"),
        ),
        (
            "a stored id with another state",
            InsertRequest {
                ids: vec![10, 2],
                states: Some(row_states(
                    &[good_row(), vec![0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]].concat(),
                    7,
                )),
                ..good()
            },
            (AlreadyExists, "POINTS_EXIST", ""),
        ),
        (
            "a stored id with another tag",
            InsertRequest {
                ids: vec![10, 3],
                tags: vec![0, 1],
                ..good()
            },
            (AlreadyExists, "POINTS_EXIST", ""),
        ),
        (
            "a bad row after a good one",
            InsertRequest {
                states: Some(row_states(&[good_row(), vec![f64::NAN; 7]].concat(), 7)),
                neighbors: None,
                ..good()
            },
            bad("NAN", "states[1].coords[0]"),
        ),
    ];
    for (what, request, expected) in cases {
        let answer = bench.stubs.points.clone().insert(request).await;
        let refusal = bench.refused(what, answer, expected).await;
        if expected.0 == AlreadyExists {
            let ids = &refusal.details.error_info().unwrap().metadata["ids"];
            assert!(["2", "3"].contains(&ids.as_str()), "{what}: {ids}");
        }
    }
    // The same content is no conflict, and changes nothing either.
    let again = InsertRequest {
        ids: vec![1, 3],
        ..good()
    };
    let answer = bench.stubs.clone().insert(again).await;
    assert_eq!(number(&answer.revision), bench.content.revision);
}

#[tokio::test]
async fn bad_updates_and_removals_are_refused_whole() {
    let bench = Bench::new().await;
    let mut stub = bench.stubs.points.clone();
    let good = || UpdateRequest {
        index: INDEX.into(),
        ids: vec![1, 2],
        tags: vec![9],
        ..Default::default()
    };
    let bad = |reason, field| (InvalidArgument, reason, field);
    let updates: Vec<(&str, UpdateRequest, Expected)> = vec![
        (
            "an unknown index",
            UpdateRequest {
                index: "nowhere".into(),
                ..good()
            },
            (NotFound, "INDEX_NOT_FOUND", ""),
        ),
        (
            "a missing id",
            UpdateRequest {
                ids: vec![1, 77],
                ..good()
            },
            (NotFound, "POINTS_NOT_FOUND", ""),
        ),
        (
            "an id twice",
            UpdateRequest {
                ids: vec![2, 2],
                ..good()
            },
            bad("DUPLICATE_ID", "ids[1]"),
        ),
        (
            "three tags for two ids",
            UpdateRequest {
                tags: vec![1, 2, 3],
                ..good()
            },
            bad("COUNT", "tags"),
        ),
        (
            "a payload for one of two ids",
            UpdateRequest {
                payloads: vec!["a".into()],
                ..good()
            },
            bad("COUNT", "payloads"),
        ),
        (
            "a revision without its uid",
            UpdateRequest {
                if_revision: revision("", 1),
                ..good()
            },
            bad("REQUIRED", "if_revision.uid"),
        ),
        (
            "another uid",
            UpdateRequest {
                uid: "another".into(),
                ..good()
            },
            (FailedPrecondition, "UID_MISMATCH", ""),
        ),
        (
            "a revision before the points",
            UpdateRequest {
                if_revision: revision(&bench.content.uid, 0),
                ..good()
            },
            (FailedPrecondition, "REVISION_CONFLICT", ""),
        ),
        (
            "a long operation id",
            UpdateRequest {
                operation_id: "x".repeat(65),
                ..good()
            },
            bad("TOO_LONG", "operation_id"),
        ),
    ];
    for (what, request, expected) in updates {
        let answer = stub.update(request).await;
        bench.refused(what, answer, expected).await;
    }

    let good = || RemoveRequest {
        index: INDEX.into(),
        ids: vec![1, 2],
        ..Default::default()
    };
    let removals: Vec<(&str, RemoveRequest, Expected)> = vec![
        (
            "an unknown index",
            RemoveRequest {
                index: "nowhere".into(),
                ..good()
            },
            (NotFound, "INDEX_NOT_FOUND", ""),
        ),
        (
            "an id twice",
            RemoveRequest {
                ids: vec![1, 2, 1],
                ..good()
            },
            bad("DUPLICATE_ID", "ids[2]"),
        ),
        (
            "another uid",
            RemoveRequest {
                uid: "another".into(),
                ..good()
            },
            (FailedPrecondition, "UID_MISMATCH", ""),
        ),
    ];
    for (what, request, expected) in removals {
        let answer = stub.remove(request).await;
        bench.refused(what, answer, expected).await;
    }
}
