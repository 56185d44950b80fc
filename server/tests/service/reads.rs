//! The points that a read returns: columns, filters, and the revision it waits for.

use std::{
    pin::pin,
    time::{Duration, Instant},
};

use bytes::Bytes;
use futures_util::FutureExt;
use tokio::time::timeout;
use wayfold_proto::v1;
use wayfold_server::service::{Call, Code};

use crate::support::*;

const ALL: v1::Include = v1::Include {
    with_states: true,
    with_tags: true,
    with_revisions: true,
    with_payloads: true,
};

#[tokio::test]
async fn neighbours_come_with_the_requested_columns() {
    let (service, uid) = arm("SO2").await;
    let request = v1::InsertRequest {
        tags: vec![1, 2, 3],
        payloads: vec![Bytes::new(), Bytes::from_static(b"two"), Bytes::new()],
        // Wrapped into [-pi, pi).
        ..insertion(&[[0.0], [1.0 + 8.0 * std::f64::consts::PI], [2.0]], &[])
    };
    service.insert(&CALL, request).await.unwrap();
    let request = v1::KnnRequest {
        include: Some(ALL),
        ..knn(&[[1.25], [-1.0]], 2)
    };
    let response = service.knn(&CALL, request).await.unwrap();
    assert_eq!(
        (response.revision.number(), response.revision.uid()),
        (1, uid)
    );
    let found = response.neighbors.unwrap();
    assert_eq!(found.neighbor_counts, [2, 2]);
    assert_eq!(found.ids, [1, 2, 0, 1]);
    assert_eq!(found.tags, [2, 3, 1, 2]);
    assert_eq!(found.revisions, [1; 4]);
    assert_eq!(found.payloads[0], Bytes::from_static(b"two"));
    assert_eq!(found.payloads[1], Bytes::new());
    let states = found.states.unwrap();
    assert_eq!(states.row_count, 4);
    let near = |a: f64, b: f64| (a - b).abs() < 1e-12;
    assert!(near(states.coordinates[0], 1.0) && states.coordinates[1] == 2.0);
    assert!(near(found.distances[0], 0.25) && found.distances[2] == 1.0);

    let bare = service
        .knn(&CALL, knn(&[[1.25]], 2))
        .await
        .unwrap()
        .neighbors
        .unwrap();
    assert_eq!(
        (bare.states, bare.tags, bare.payloads),
        (None, vec![], vec![])
    );
}

#[tokio::test]
async fn filters_by_tag_and_by_revision() {
    let (service, uid) = arm("R1").await;
    for (at, tag) in [0b01, 0b10, 0b11, 0b01].into_iter().enumerate() {
        let request = v1::InsertRequest {
            tags: vec![tag],
            ..insertion(&[[at as f64]], &[])
        };
        service.insert(&CALL, request).await.unwrap();
    }
    let ask = |tag_mask, tag_value, since| v1::QueryRequest {
        index_name: "arm".into(),
        states: states(&[[0.0]]),
        radius_form: within(f64::INFINITY),
        filter: Some(v1::Filter {
            tag_mask,
            tag_value,
            since_revision: revision(&uid, since),
        }),
        ..Default::default()
    };
    for (mask, value, since, expected) in [
        (0, 0, 0, vec![0, 1, 2, 3]),
        (0b01, 0b01, 0, vec![0, 2, 3]),
        (0b11, 0b01, 0, vec![0, 3]),
        (0b11, 0b01, 1, vec![3]),
        (0, 0, 2, vec![2, 3]),
        (0, 0, 4, vec![]),
    ] {
        let answer = service.query(&CALL, ask(mask, value, since)).await.unwrap();
        assert_eq!(
            answer.neighbors.unwrap().ids,
            expected,
            "{mask} {value} {since}"
        );
    }
}

#[tokio::test]
async fn the_ball_is_closed_and_both_limits_hold() {
    let (service, _) = arm("R1").await;
    insert_rows(&service, &[[0.0], [1.0], [2.0]], &[]).await;
    let query = |radius| v1::QueryRequest {
        index_name: "arm".into(),
        states: states(&[[0.0]]),
        radius_form: within(radius),
        ..Default::default()
    };
    let ids = |response: v1::QueryResponse| response.neighbors.unwrap().ids;
    assert_eq!(ids(service.query(&CALL, query(0.0)).await.unwrap()), [0]);
    assert_eq!(ids(service.query(&CALL, query(1.0)).await.unwrap()), [0, 1]);
    let both = |k, radius| v1::KnnRequest {
        radius_form: within(radius),
        ..knn(&[[0.0]], k)
    };
    let ids = |response: v1::KnnResponse| response.neighbors.unwrap().ids;
    assert_eq!(ids(service.knn(&CALL, both(1, 1.0)).await.unwrap()), [0]);
    assert_eq!(ids(service.knn(&CALL, both(9, 1.0)).await.unwrap()), [0, 1]);
    assert_eq!(
        ids(service.knn(&CALL, both(9, f64::INFINITY)).await.unwrap()),
        [0, 1, 2]
    );
}

#[tokio::test]
async fn a_read_waits_for_its_revision() {
    let (service, uid) = arm("R1").await;
    let request = v1::KnnRequest {
        min_revision: revision(&uid, 2),
        ..knn(&[[0.0]], 9)
    };
    let reading = tokio::spawn({
        let service = service.clone();
        async move { service.knn(&CALL, request).await }
    });
    for row in [[1.0], [2.0]] {
        assert!(!reading.is_finished());
        service.insert(&CALL, insertion(&[row], &[])).await.unwrap();
    }
    let response = reading.await.unwrap().unwrap();
    assert_eq!(
        (response.revision.number(), response.neighbors.unwrap().ids),
        (2, vec![0, 1])
    );
}

/// A client asks for the changes after a revision. A server that has not reached that revision must not answer
/// "nothing".
#[tokio::test]
async fn a_read_waits_for_the_revision_it_asks_after() {
    let (service, uid) = arm("R1").await;
    let request = v1::KnnRequest {
        filter: Some(v1::Filter {
            since_revision: revision(&uid, 2),
            ..Default::default()
        }),
        ..knn(&[[0.0]], 9)
    };
    let mut reading = pin!(service.knn(&CALL, request.clone()));
    assert!((&mut reading).now_or_never().is_none());
    for row in [[1.0], [2.0]] {
        service.insert(&CALL, insertion(&[row], &[])).await.unwrap();
    }
    let response = reading.await.unwrap();
    assert_eq!(
        (response.revision.number(), response.neighbors.unwrap().ids),
        (2, vec![])
    );
    insert_rows(&service, &[[3.0]], &[]).await;
    let response = service.knn(&CALL, request).await.unwrap();
    assert_eq!(response.neighbors.unwrap().ids, [2]);
}

/// The clock jumps ahead whenever no task can run.
#[tokio::test(start_paused = true)]
async fn the_wait_for_a_revision_ends_after_five_seconds_or_at_the_deadline() {
    let (service, uid) = arm("R1").await;
    let request = v1::GetRequest {
        min_revision: revision(&uid, 1),
        ..getting(&[])
    };
    let hour = Duration::from_secs(3600);
    let with_deadline = Call {
        deadline: Some(Instant::now() + hour),
        ..Call::default()
    };
    for (call, not_yet, done) in [
        (
            CALL.clone(),
            Duration::from_millis(4990),
            Duration::from_millis(20),
        ),
        (with_deadline, hour / 2, hour),
    ] {
        let mut waiting = pin!(service.get(&call, request.clone()));
        assert!(timeout(not_yet, &mut waiting).await.is_err());
        let answer = timeout(done, waiting).await.unwrap();
        assert_eq!(refusal(answer).0, Code::DeadlineExceeded);
    }
}

#[tokio::test]
async fn the_wait_for_a_revision_ends_when_the_server_stops() {
    let (service, uid) = arm("R1").await;
    let request = v1::GetRequest {
        min_revision: revision(&uid, 1),
        ..getting(&[])
    };
    let with_deadline = Call {
        deadline: Some(Instant::now() + Duration::from_secs(3600)),
        ..Call::default()
    };
    let mut waiting = pin!(service.get(&with_deadline, request));
    assert!((&mut waiting).now_or_never().is_none());
    service.begin_shutdown();
    let refused = waiting.now_or_never().expect("it waits on");
    assert_eq!(refusal(refused).0, Code::Unavailable);
}
