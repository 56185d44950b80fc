//! Calls with an operation id take effect once.

use prost::Message;
use wayfold_proto::v1;
use wayfold_server::service::{Code, Error, Limits};

use crate::support::*;

fn once(id: &str, row: f64) -> v1::InsertRequest {
    v1::InsertRequest {
        operation_id: id.into(),
        neighbor_spec: Some(v1::NeighborSpec {
            k_form: nearest(3),
            ..Default::default()
        }),
        ..insertion(&[[row]], &[])
    }
}

#[tokio::test]
async fn a_retry_gets_the_original_response_bit_for_bit() {
    let (service, _) = arm("R1").await;
    insert_rows(&service, &[[0.0], [1.0]], &[]).await;
    let first = service.insert(&CALL, once("op", 0.1)).await.unwrap();
    insert_rows(&service, &[[0.2]], &[]).await;
    let retry = service.insert(&CALL, once("op", 0.1)).await.unwrap();
    assert_eq!(retry.encode_to_vec(), first.encode_to_vec());
    assert_eq!(info(&service, "arm").await.point_count, 4);

    let removal = v1::RemoveRequest {
        operation_id: "remove".into(),
        ..removal(&[0, 9])
    };
    let first = service.remove(&CALL, removal.clone()).await.unwrap();
    assert_eq!(service.remove(&CALL, removal).await.unwrap(), first);
    let update = v1::UpdateRequest {
        tags: vec![4],
        operation_id: "update".into(),
        ..updating(&[1])
    };
    let first = service.update(&CALL, update.clone()).await.unwrap();
    assert_eq!(first.updated_count, 1);
    assert_eq!(service.update(&CALL, update).await.unwrap(), first);
}

#[tokio::test]
async fn other_content_or_another_verb_under_the_same_id_is_refused() {
    let (service, _) = arm("R1").await;
    service.insert(&CALL, once("op", 0.1)).await.unwrap();
    let removal = v1::RemoveRequest {
        operation_id: "op".into(),
        ..removal(&[0])
    };
    let tagged = v1::InsertRequest {
        tags: vec![1],
        ..once("op", 0.1)
    };
    let errors = [
        service.insert(&CALL, once("op", 0.2)).await.unwrap_err(),
        service.insert(&CALL, tagged).await.unwrap_err(),
        service.remove(&CALL, removal).await.unwrap_err(),
    ];
    for error in errors {
        assert_eq!(error.code(), Code::InvalidArgument);
        let mismatch = Error::OperationMismatch {
            operation_id: "op".into(),
        };
        assert_eq!(error, mismatch);
    }
    assert_eq!(info(&service, "arm").await.revision.number(), 1);
}

#[tokio::test]
async fn a_call_that_changed_nothing_is_remembered_too() {
    let (service, _) = arm("R1").await;
    let removal = v1::RemoveRequest {
        operation_id: "op".into(),
        ..removal(&[5])
    };
    let first = service.remove(&CALL, removal.clone()).await.unwrap();
    assert_eq!((first.removed_count, first.revision.number()), (0, 0));
    insert_rows(&service, &[[1.0]], &[5]).await;
    assert_eq!(service.remove(&CALL, removal).await.unwrap(), first);
    assert_eq!(info(&service, "arm").await.point_count, 1);
}

#[tokio::test]
async fn a_call_that_failed_is_not_remembered() {
    let (service, _) = arm("R1").await;
    insert_rows(&service, &[[1.0]], &[5]).await;
    let request = v1::InsertRequest {
        operation_id: "op".into(),
        ..insertion(&[[2.0]], &[5])
    };
    service.insert(&CALL, request.clone()).await.unwrap_err();
    service.remove(&CALL, removal(&[5])).await.unwrap();
    let response = service.insert(&CALL, request).await.unwrap();
    assert_eq!(response.revision.number(), 3);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn twins_in_flight_take_effect_once() {
    let (service, _) = arm("R1").await;
    for round in 0..50u32 {
        let mut twins = tokio::task::JoinSet::new();
        for _ in 0..32 {
            let service = service.clone();
            let request = once(&format!("op {round}"), f64::from(round));
            twins.spawn(async move { service.insert(&CALL, request).await.unwrap() });
        }
        let responses = twins.join_all().await;
        assert!(responses.iter().all(|response| *response == responses[0]));
        let count = u64::from(round) + 1;
        assert_eq!(responses[0].revision.number(), count);
        assert_eq!(info(&service, "arm").await.point_count, count);
    }
}

#[tokio::test]
async fn the_window_ends_and_a_new_past_starts_an_empty_one() {
    let limits = Limits {
        max_operations: 2,
        ..Limits::default()
    };
    let (service, _) = arm_with("R1", limits).await;
    for (at, id) in ["a", "b", "c"].into_iter().enumerate() {
        service.insert(&CALL, once(id, at as f64)).await.unwrap();
    }
    // The operations c and b are remembered, a is forgotten.
    assert_eq!(
        service
            .insert(&CALL, once("c", 2.0))
            .await
            .unwrap()
            .revision
            .number(),
        3
    );
    assert_eq!(
        service
            .insert(&CALL, once("b", 1.0))
            .await
            .unwrap()
            .revision
            .number(),
        2
    );
    assert_eq!(
        service
            .insert(&CALL, once("a", 0.0))
            .await
            .unwrap()
            .revision
            .number(),
        4
    );

    delete(&service, "arm").await;
    let uid = create(&service, "arm", "R1").await;
    let repeated = service.insert(&CALL, once("a", 0.0)).await.unwrap();
    assert_eq!(repeated.revision, revision(&uid, 1));
    assert_eq!(info(&service, "arm").await.point_count, 1);
}
