//! Updates and removals.

use bytes::Bytes;
use wayfold_proto::v1;
use wayfold_server::service::{Code, Error};

use crate::support::*;

#[tokio::test]
async fn tags_and_payloads_change_and_the_state_keeps_its_revision() {
    let (service, _) = arm("R1").await;
    let request = v1::InsertRequest {
        tags: vec![0b1100, 0b1100],
        payloads: vec![Bytes::from_static(b"a"), Bytes::from_static(b"b")],
        ..insertion(&[[1.0], [2.0]], &[])
    };
    service.insert(&CALL, request).await.unwrap();
    let masked = v1::UpdateRequest {
        tags: vec![0b0101],
        tag_mask: Some(0b0111),
        ..updating(&[0, 1])
    };
    let response = service.update(&CALL, masked.clone()).await.unwrap();
    assert_eq!(
        (
            response.updated_count,
            response.unchanged_count,
            response.revision.number()
        ),
        (2, 0, 2)
    );
    let again = service.update(&CALL, masked).await.unwrap();
    assert_eq!(
        (
            again.updated_count,
            again.unchanged_count,
            again.revision.number()
        ),
        (0, 2, 2)
    );
    let payloads = v1::UpdateRequest {
        payloads: vec![Bytes::from_static(b"c"), Bytes::from_static(b"b")],
        ..updating(&[0, 1])
    };
    let response = service.update(&CALL, payloads).await.unwrap();
    assert_eq!(
        (
            response.updated_count,
            response.unchanged_count,
            response.revision.number()
        ),
        (1, 1, 3)
    );

    let points = service
        .get(&CALL, getting(&[1, 0]))
        .await
        .unwrap()
        .points
        .unwrap();
    assert_eq!(points.ids, [1, 0]);
    assert_eq!(points.tags, [0b1101, 0b1101]);
    assert_eq!(points.revisions, [1, 1]);
    assert_eq!(
        points.payloads,
        [Bytes::from_static(b"b"), Bytes::from_static(b"c")]
    );
}

#[tokio::test]
async fn if_revision_compares_with_the_last_change_of_the_whole_point() {
    let (service, uid) = arm("R1").await;
    insert_rows(&service, &[[1.0], [2.0], [3.0]], &[]).await;
    let set = |ids: &[u64], tag, if_revision| v1::UpdateRequest {
        tags: vec![tag],
        if_revision: revision(&uid, if_revision),
        ..updating(ids)
    };
    service.update(&CALL, set(&[1], 5, 1)).await.unwrap();
    // Only the tag of 1 has changed, at revision 2.
    let error = service
        .update(&CALL, set(&[0, 1, 2], 6, 1))
        .await
        .unwrap_err();
    let conflict = Error::RevisionConflict {
        index: "arm".into(),
        if_revision: 1,
        ids: vec![1],
    };
    assert_eq!(error, conflict);
    assert_eq!(info(&service, "arm").await.revision.number(), 2);
    let response = service.update(&CALL, set(&[0, 1, 2], 6, 2)).await.unwrap();
    assert_eq!((response.updated_count, response.revision.number()), (3, 3));
    let unnamed = v1::UpdateRequest {
        if_revision: Some(v1::Revision::default()),
        ..set(&[0], 7, 0)
    };
    let refused = refusal(service.update(&CALL, unnamed).await);
    let expected = (Code::InvalidArgument, "REQUIRED", "if_revision.uid".into());
    assert_eq!(refused, expected);
}

#[tokio::test]
async fn one_of_concurrent_compare_and_sets_wins() {
    let (service, uid) = arm("R1").await;
    insert_rows(&service, &[[1.0]], &[]).await;
    let mut calls = tokio::task::JoinSet::new();
    for tag in 1..=20 {
        let service = service.clone();
        let request = v1::UpdateRequest {
            tags: vec![tag],
            if_revision: revision(&uid, 1),
            ..updating(&[0])
        };
        calls.spawn(async move { service.update(&CALL, request).await });
    }
    let won = calls
        .join_all()
        .await
        .into_iter()
        .filter(|answer| answer.is_ok())
        .count();
    assert_eq!((won, info(&service, "arm").await.revision.number()), (1, 2));
}

#[tokio::test]
async fn missing_points_are_named_and_nothing_is_updated() {
    let (service, _) = arm("R1").await;
    insert_rows(&service, &[[1.0]], &[]).await;
    let request = v1::UpdateRequest {
        tags: vec![1],
        ..updating(&[0, 8, 9])
    };
    let error = service.update(&CALL, request).await.unwrap_err();
    let missing = Error::PointsNotFound {
        index: "arm".into(),
        ids: vec![8, 9],
    };
    assert_eq!(error, missing);
    assert_eq!(info(&service, "arm").await.revision.number(), 1);
    assert_eq!(
        service.get(&CALL, getting(&[8, 0, 9])).await.unwrap_err(),
        missing
    );
}

#[tokio::test]
async fn removals_count_missing_points() {
    let (service, _) = arm("R1").await;
    insert_rows(&service, &[[1.0], [2.0]], &[]).await;
    let response = service.remove(&CALL, removal(&[1, 7])).await.unwrap();
    assert_eq!(
        (
            response.removed_count,
            response.missing_count,
            response.revision.number()
        ),
        (1, 1, 2)
    );
    let again = service.remove(&CALL, removal(&[1, 7])).await.unwrap();
    assert_eq!(
        (
            again.removed_count,
            again.missing_count,
            again.revision.number()
        ),
        (0, 2, 2)
    );
    assert_eq!(everything(&service).await.points.unwrap().ids, [0]);
}
