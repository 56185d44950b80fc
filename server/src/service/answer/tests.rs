//! Answers hold bytes while they are made, and give them back.

use std::sync::Arc;

use super::*;
use crate::{
    service::Service,
    testing::{admission, arm, engine, server},
};

const MIB: usize = 1024 * 1024;

const WITH_PAYLOADS: Option<v1::Include> = Some(v1::Include {
    with_states: false,
    with_tags: false,
    with_revisions: false,
    with_payloads: true,
});

/// A service whose index `arm` has ten points with 30,000 bytes of payload each.
fn service() -> Service {
    let log = engine(&arm(), 10);
    server(&log, &log)
}

fn one_state() -> Option<v1::States> {
    Some(v1::States {
        row_count: 1,
        coordinates: vec![0.5],
    })
}

#[tokio::test]
async fn large_answers_are_refused_without_room_and_give_everything_back() {
    let (service, admission) = (service(), admission(64 * MIB));
    let (other, flow) = (admission.open().hold(), admission.open());
    let call = Call {
        held: Some(Arc::new(flow.hold())),
        ..Call::default()
    };
    let knn = v1::KnnRequest {
        index_name: "arm".into(),
        states: one_state(),
        k_form: Some(v1::knn_request::KForm::K(10)),
        include: WITH_PAYLOADS,
        ..Default::default()
    };
    let get = v1::GetRequest {
        index_name: "arm".into(),
        ids: (0..10).collect(),
        include: WITH_PAYLOADS,
        ..Default::default()
    };
    let scan = v1::ScanRequest {
        index_name: "arm".into(),
        include: WITH_PAYLOADS,
        ..Default::default()
    };
    // Only flows that hold little may take the last eighth.
    for (others, is_refused) in [(58 * MIB, true), (0, false)] {
        other.force_take(others);
        for answered in [
            service.knn(&call, knn.clone()).await.map(drop),
            service.get(&call, get.clone()).await.map(drop),
            service.scan_page(&call, scan.clone()).await.map(drop),
        ] {
            let refused = matches!(answered, Err(Error::TooManyBytes { .. }));
            assert_eq!(refused, is_refused, "{answered:?}");
            assert!(is_refused || answered.is_ok(), "{answered:?}");
        }
        assert_eq!(flow.held(), 0);
        other.release_all();
    }
    // Their small parts need no room.
    other.force_take(58 * MIB);
    let without_payloads = v1::KnnRequest {
        include: None,
        ..knn
    };
    service.knn(&call, without_payloads).await.unwrap();
}

#[tokio::test]
async fn an_insert_without_room_for_its_answer_changes_nothing() {
    let (service, admission) = (service(), admission(64 * MIB));
    let (other, flow) = (admission.open().hold(), admission.open());
    let call = Call {
        held: Some(Arc::new(flow.hold())),
        ..Call::default()
    };
    let insertion = v1::InsertRequest {
        index_name: "arm".into(),
        states: one_state(),
        neighbor_spec: Some(v1::NeighborSpec {
            k_form: Some(v1::neighbor_spec::KForm::K(10)),
            include: WITH_PAYLOADS,
            ..Default::default()
        }),
        ..Default::default()
    };
    let points = async || {
        let info = v1::GetIndexRequest {
            index_name: "arm".into(),
        };
        let info = service.get_index(&call, info).await.unwrap();
        info.index.unwrap().point_count
    };
    other.force_take(58 * MIB);
    let refused = service.insert(&call, insertion.clone()).await;
    assert!(
        matches!(refused, Err(Error::TooManyBytes { .. })),
        "{refused:?}"
    );
    assert_eq!((points().await, flow.held()), (10, 0));
    other.release_all();
    service.insert(&call, insertion).await.unwrap();
    assert_eq!((points().await, flow.held()), (11, 0));
}
