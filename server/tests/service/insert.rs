//! The effect and the answer of an insert in selected cases; a random comparison with a model covers the rest.

use bytes::Bytes;
use wayfold_proto::v1::{self, Outcome};
use wayfold_server::service::{Code, Error};

use crate::support::*;

fn outcomes(response: &v1::InsertResponse) -> Vec<Outcome> {
    response
        .outcomes
        .iter()
        .map(|&outcome| outcome.try_into().unwrap())
        .collect()
}

#[tokio::test]
async fn assigned_ids_run_upwards_and_are_never_used_again() {
    let (service, uid) = arm("R1").await;
    let first = insert_rows(&service, &[[1.0], [2.0]], &[]).await;
    assert_eq!(
        (first.ids, first.revision.number(), first.revision.uid()),
        (vec![0, 1], 1, uid)
    );
    insert_rows(&service, &[[3.0]], &[40]).await;
    service.remove(&CALL, removal(&[40])).await.unwrap();
    // A row that is left out takes no id.
    let request = v1::InsertRequest {
        min_separation: 0.5,
        ..insertion(&[[7.0], [7.1], [8.0]], &[])
    };
    let after = service.insert(&CALL, request).await.unwrap();
    assert_eq!(
        outcomes(&after),
        [Outcome::Inserted, Outcome::TooClose, Outcome::Inserted]
    );
    assert_eq!(after.ids, [41, 41, 42]);
}

#[tokio::test]
async fn ids_end_below_2_to_the_63() {
    let (service, _) = arm("R1").await;
    let last = (1 << 63) - 1;
    insert_rows(&service, &[[1.0]], &[last]).await;
    let before = everything(&service).await;
    let error = service
        .insert(&CALL, insertion(&[[2.0]], &[]))
        .await
        .unwrap_err();
    assert_eq!(
        error,
        Error::IdsExhausted {
            index: "arm".into()
        }
    );
    assert_eq!(error.code(), Code::ResourceExhausted);
    assert_eq!(everything(&service).await, before);
    // Ids chosen by the caller stay taken.
    insert_rows(&service, &[[2.0]], &[5]).await;
}

#[tokio::test]
async fn the_same_point_again_is_unchanged_and_makes_no_revision() {
    let (service, _) = arm("SO2").await;
    let request = v1::InsertRequest {
        tags: vec![7],
        payloads: vec![Bytes::from_static(b"pose")],
        ..insertion(&[[0.5]], &[1])
    };
    service.insert(&CALL, request.clone()).await.unwrap();
    // The same angle, bit for bit, once it is canonical; min_separation does not matter.
    let again = v1::InsertRequest {
        min_separation: 1.0,
        ..request.clone()
    };
    let response = service.insert(&CALL, again).await.unwrap();
    assert_eq!(outcomes(&response), [Outcome::Unchanged]);
    assert_eq!(
        (
            response.revision.number(),
            info(&service, "arm").await.revision.number()
        ),
        (1, 1)
    );

    let other_state = v1::InsertRequest {
        states: states(&[[0.25]]),
        ..request.clone()
    };
    let other_tag = v1::InsertRequest {
        tags: vec![8],
        ..request.clone()
    };
    let other_payload = v1::InsertRequest {
        payloads: vec![],
        ..request
    };
    for (made, other) in [other_state, other_tag, other_payload]
        .into_iter()
        .enumerate()
    {
        let error = service.insert(&CALL, other.clone()).await.unwrap_err();
        let exist = Error::PointsExist {
            index: "arm".into(),
            ids: vec![1],
        };
        assert_eq!(error, exist);
        let replace = v1::InsertRequest {
            on_conflict: v1::OnConflict::Replace.into(),
            ..other
        };
        let response = service.insert(&CALL, replace).await.unwrap();
        assert_eq!(outcomes(&response), [Outcome::Replaced]);
        assert_eq!(response.revision.number(), 2 + made as u64);
    }
    let points = everything(&service).await.points.unwrap();
    assert_eq!(
        (points.ids, points.tags, points.revisions),
        (vec![1], vec![7], vec![4])
    );
}

#[tokio::test]
async fn conflicts_are_named_all_and_nothing_is_stored() {
    let (service, _) = arm("R1").await;
    insert_rows(&service, &[[1.0], [2.0], [3.0]], &[1, 2, 3]).await;
    let before = everything(&service).await;
    let request = insertion(&[[9.0], [1.0], [2.5], [3.5]], &[9, 1, 2, 3]);
    let error = service.insert(&CALL, request).await.unwrap_err();
    let exist = Error::PointsExist {
        index: "arm".into(),
        ids: vec![2, 3],
    };
    assert_eq!(error, exist);
    assert_eq!(everything(&service).await, before);
}

#[tokio::test]
async fn separation_is_strict_and_counts_the_rows_before() {
    let (service, _) = arm("R1").await;
    insert_rows(&service, &[[0.0]], &[]).await;
    let request = v1::InsertRequest {
        min_separation: 1.0,
        ..insertion(&[[0.75], [1.0], [1.75], [2.0], [1.0]], &[])
    };
    let response = service.insert(&CALL, request).await.unwrap();
    use Outcome::{Inserted, TooClose};
    assert_eq!(
        outcomes(&response),
        [TooClose, Inserted, TooClose, Inserted, TooClose]
    );
    // The blockers are 0 at 0.0 and, for 1.75, 1 at 1.0, because 2 was not stored yet.
    assert_eq!(response.ids, [0, 1, 1, 2, 1]);
}

#[tokio::test]
async fn a_replaced_point_is_neither_in_its_own_way_nor_its_own_neighbour() {
    let (service, _) = arm("R1").await;
    insert_rows(&service, &[[0.0], [5.0]], &[1, 2]).await;
    let request = v1::InsertRequest {
        on_conflict: v1::OnConflict::Replace.into(),
        min_separation: 1.0,
        neighbor_spec: Some(v1::NeighborSpec {
            k_form: nearest(10),
            include: Some(v1::Include {
                with_revisions: true,
                ..Default::default()
            }),
            ..Default::default()
        }),
        // Point 1 moves by less than the separation; then 3 is inserted at its old place, near its new one.
        ..insertion(&[[0.25], [0.0], [-2.0]], &[1, 3, 4])
    };
    let response = service.insert(&CALL, request).await.unwrap();
    use Outcome::{Inserted, Replaced, TooClose};
    assert_eq!(outcomes(&response), [Replaced, TooClose, Inserted]);
    assert_eq!(response.ids, [1, 1, 4]);
    let neighbors = response.neighbors.unwrap();
    assert_eq!(neighbors.neighbor_counts, [1, 2, 2]);
    assert_eq!(neighbors.ids, [2, 1, 2, 1, 2]);
    assert_eq!(neighbors.distances, [4.75, 0.25, 5.0, 2.25, 7.0]);
    assert_eq!(neighbors.revisions, [1, 2, 1, 2, 1]);
}

#[tokio::test]
async fn neighbours_since_a_revision_are_what_came_meanwhile_and_the_same_call() {
    let (service, uid) = arm("R1").await;
    insert_rows(&service, &[[0.0]], &[]).await;
    let checked_at = insert_rows(&service, &[[1.0]], &[]).await.revision;
    insert_rows(&service, &[[2.0]], &[]).await;
    let request = v1::InsertRequest {
        uid,
        neighbor_spec: Some(v1::NeighborSpec {
            radius_form: within(f64::INFINITY),
            filter: Some(v1::Filter {
                since_revision: checked_at,
                ..Default::default()
            }),
            ..Default::default()
        }),
        ..insertion(&[[3.0], [4.0]], &[])
    };
    let neighbors = service
        .insert(&CALL, request)
        .await
        .unwrap()
        .neighbors
        .unwrap();
    assert_eq!(neighbors.neighbor_counts, [1, 2]);
    assert_eq!(neighbors.ids, [2, 3, 2]);
}

#[tokio::test]
async fn the_later_of_two_concurrent_inserts_sees_the_earlier() {
    let (service, _) = arm("R3").await;
    let mut calls = tokio::task::JoinSet::new();
    for row in cube(5, 200) {
        let service = service.clone();
        let request = v1::InsertRequest {
            neighbor_spec: Some(v1::NeighborSpec {
                radius_form: within(f64::INFINITY),
                ..Default::default()
            }),
            ..insertion(&[row], &[])
        };
        calls.spawn(async move { service.insert(&CALL, request).await.unwrap() });
    }
    for response in calls.join_all().await {
        let mut seen = response.neighbors.unwrap().ids;
        seen.sort_unstable();
        // Revision n stores the n-th row, with the id n - 1.
        assert_eq!(
            seen,
            (0..response.revision.number() - 1).collect::<Vec<_>>()
        );
    }
}

#[tokio::test]
async fn no_rows_change_nothing() {
    let (service, _) = arm("R3").await;
    let none: [[f64; 3]; 0] = [];
    let response = service.insert(&CALL, insertion(&none, &[])).await.unwrap();
    assert_eq!((response.outcomes, response.revision.number()), (vec![], 0));
    assert_eq!(
        service
            .remove(&CALL, removal(&[]))
            .await
            .unwrap()
            .revision
            .number(),
        0
    );
}

#[tokio::test]
async fn a_bulk_insert_is_one_revision_and_merges_go_on_behind_it() {
    let (service, _) = arm("R3").await;
    let rows = cube(1, 5000);
    let response = service.insert(&CALL, insertion(&rows, &[])).await.unwrap();
    assert_eq!(response.revision.number(), 1);
    assert_eq!(response.ids, (0..5000).collect::<Vec<_>>());
    for (id, row) in rows.iter().enumerate().step_by(500) {
        let answer = service.knn(&CALL, knn(&[*row], 1)).await.unwrap();
        assert_eq!(answer.neighbors.unwrap().ids, [id as u64]);
    }
}
