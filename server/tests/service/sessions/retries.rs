//! The newest batch of a session is recognised, and no other batch than the next one is taken.

use std::{fs, sync::Arc};

use futures_util::poll;
use tokio::task::JoinSet;
use wayfold_proto::v1;
use wayfold_server::{
    log::{Durability, FjallLog, Log, MemoryLog},
    service::{Code, Limits},
};

use super::*;
use crate::copied::copied;

/// The index remembers two operations.
fn forgetful() -> Limits {
    Limits {
        max_operations: 2,
        max_operation_bytes: 300,
        ..Limits::default()
    }
}

/// A late retry of a put, whose point was removed, would bring the point back.
#[tokio::test]
async fn a_retry_is_recognised_after_a_flood_and_after_a_restart() {
    for on_disk in [false, true] {
        let directory = tempfile::tempdir().unwrap();
        let open_log = |path| -> Log {
            match on_disk {
                true => Arc::new(FjallLog::open(path, Durability::Fsync).unwrap()).into(),
                false => Arc::new(MemoryLog::new()).into(),
            }
        };
        let log = open_log(directory.path());
        let service = service_with(log.clone(), forgetful());
        let uid = create(&service, "arm", "R1").await;
        let (session, _) = open(&service, &uid, 4).await;
        let steps = [Put(session.first, 0.5), Tag(session.first, 7), Remove(99)];
        let newest = v1::WriteRequest {
            reserve_count: 3,
            ..batch(&session, 1, &steps)
        };
        let response = write(&service, newest.clone()).await;
        assert_eq!((response.missing_count, response.revision.number()), (1, 2));
        service
            .remove(&CALL, removal(&[session.first]))
            .await
            .unwrap();
        for number in 0..50 {
            let request = v1::InsertRequest {
                operation_id: format!("{number}"),
                ..insertion(&[[f64::from(number)]], &[])
            };
            service.insert(&CALL, request).await.unwrap();
        }
        let (other, _) = open(&service, &uid, 0).await;
        for number in 1..50 {
            write(&service, batch(&other, number, &[])).await;
        }
        let before = everything(&service).await;
        assert_eq!(write(&service, newest.clone()).await, response);
        assert_eq!(everything(&service).await, before);

        let crashed = on_disk.then(|| copied(directory.path()));
        let log = match &crashed {
            Some(crashed) => open_log(crashed.path()),
            None => log,
        };
        let restarted = restarted_with(log, options(), forgetful());
        assert_eq!(everything(&restarted).await, before);
        assert_eq!(write(&restarted, newest.clone()).await, response);
        assert_eq!(everything(&restarted).await, before);
        let mut other_content = newest.clone();
        other_content.tags[1] = 8;
        let mismatch = (Code::InvalidArgument, "BATCH_MISMATCH");
        assert_eq!(refused_batch(&restarted, other_content).await, mismatch);
        let next = write(&restarted, batch(&session, 2, &[])).await;
        assert_eq!(next.revision.number(), before.revision.number() + 1);
        let late = (Code::FailedPrecondition, "BATCH_OUT_OF_ORDER");
        assert_eq!(refused_batch(&restarted, newest).await, late);
    }
}

/// The index has a new uid, because the server may have lost mutations.
#[tokio::test]
async fn a_session_goes_on_under_a_new_uid() {
    let directory = tempfile::tempdir().unwrap();
    let open_log = |path| Arc::new(FjallLog::open(path, Durability::Os).unwrap());
    let service = service_with(open_log(directory.path()), Limits::default());
    let old = create(&service, "arm", "R1").await;
    let (session, _) = open(&service, &old, 4).await;
    let newest = batch(&session, 1, &[Put(session.first, 0.5)]);
    let response = write(&service, newest.clone()).await;

    let crashed = copied(directory.path());
    // The marker of a server that ran before the last reboot.
    fs::write(crashed.path().join("unsynced"), "os another").unwrap();
    let service = restarted(open_log(crashed.path()));
    let uid = info(&service, "arm").await.revision.uid();
    assert_ne!(uid, old);
    let mismatch = (Code::FailedPrecondition, "UID_MISMATCH");
    assert_eq!(refused_batch(&service, newest.clone()).await, mismatch);
    let retry = v1::WriteRequest {
        uid: uid.clone(),
        ..newest
    };
    assert_eq!(write(&service, retry).await, response);
    let session = Opened { uid, ..session };
    let skipped = (Code::FailedPrecondition, "BATCH_OUT_OF_ORDER");
    let third = batch(&session, 3, &[]);
    assert_eq!(refused_batch(&service, third).await, skipped);
    let second = batch(&session, 2, &[Put(session.first + 1, 0.5)]);
    let next = write(&service, second).await;
    assert_eq!(next.revision, revision(&session.uid, 3));
}

/// A lost answer costs no session.
#[tokio::test]
async fn a_retry_of_an_opening_gets_the_same_session() {
    let (service, uid) = arm("R1").await;
    let request = v1::OpenSessionRequest {
        operation_id: "open".into(),
        ..opening(5)
    };
    let open = |request| service.open_session(&CALL, request);
    let (first, twin) = tokio::join!(open(request.clone()), open(request.clone()));
    let first = first.unwrap();
    assert_eq!(twin.unwrap(), first);
    let session = Opened {
        uid,
        id: first.session,
        first: first.reserved.unwrap().first_id,
    };
    write(&service, batch(&session, 1, &[Put(session.first, 0.5)])).await;
    assert_eq!(open(request.clone()).await.unwrap(), first);
    write(&service, batch(&session, 2, &[])).await;
    let other = v1::OpenSessionRequest {
        reserve_count: 6,
        ..request.clone()
    };
    let (code, reason, _) = refusal(open(other).await);
    assert_eq!(
        (code, reason),
        (Code::InvalidArgument, "OPERATION_MISMATCH")
    );
    let named = |operation_id| v1::OpenSessionRequest {
        operation_id,
        ..request.clone()
    };
    assert_ne!(
        open(named("another".into())).await.unwrap().session,
        first.session
    );
    let (code, reason, field) = refusal(open(named("x".repeat(65))).await);
    assert_eq!(
        (code, reason, &*field),
        (Code::InvalidArgument, "TOO_LONG", "operation_id")
    );
}

#[tokio::test]
async fn every_batch_makes_a_revision_also_without_a_change() {
    let (service, uid) = arm("R1").await;
    insert_rows(&service, &[[0.0]], &[7]).await;
    let (session, _) = open(&service, &uid, 0).await;
    let before = everything(&service).await;
    let batches: [(&[Step], u64); 4] = [
        (&[], 0),
        (&[Remove(8), Tag(8, 1)], 2),
        (&[Put(8, 0.5), Tag(8, 2), Remove(8), Remove(8)], 1),
        (&[Tag(7, 5), Tag(7, 0)], 0),
    ];
    for (number, (steps, missing)) in (1..).zip(batches) {
        let response = write(&service, batch(&session, number, steps)).await;
        assert_eq!(response.missing_count, missing);
        assert_eq!(response.revision, revision(&uid, 2 + number));
    }
    let after = everything(&service).await;
    assert_eq!(after.points, before.points);
    assert_eq!(after.revision.number(), 6);
    // Nothing changed after revision 2.
    let update = v1::UpdateRequest {
        tags: vec![1],
        if_revision: revision(&uid, 2),
        ..updating(&[7])
    };
    service.update(&CALL, update).await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn twins_in_flight_take_effect_once() {
    let (service, uid) = arm("R1").await;
    let (session, _) = open(&service, &uid, 1).await;
    for number in 1..50 {
        let mut twins = JoinSet::new();
        for _ in 0..32 {
            let steps = [Remove(session.first), Put(session.first, number as f64)];
            let (service, request) = (service.clone(), batch(&session, number, &steps));
            twins.spawn(async move { write(&service, request).await });
        }
        let responses = twins.join_all().await;
        assert!(responses.iter().all(|response| *response == responses[0]));
        assert_eq!(responses[0].revision.number(), number + 1);
        assert_eq!(info(&service, "arm").await.revision.number(), number + 1);
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn one_of_different_requests_under_one_number_is_taken() {
    let (service, uid) = arm("R1").await;
    let (session, _) = open(&service, &uid, 1).await;
    for number in 1..20 {
        let mut rivals = JoinSet::new();
        for rival in 0..16u64 {
            let steps = [Put(session.first, rival as f64)];
            let (service, request) = (service.clone(), batch(&session, number, &steps));
            rivals.spawn(async move { (rival, service.write(&CALL, request).await) });
        }
        let mut taken = Vec::new();
        for (rival, answer) in rivals.join_all().await {
            match answer {
                Ok(_) => taken.push(rival as f64),
                Err(error) => assert_eq!(error.reason(), "BATCH_MISMATCH"),
            }
        }
        assert_eq!(taken.len(), 1);
        let points = everything(&service).await.points.unwrap();
        assert_eq!(points.states.unwrap().coordinates, taken);
    }
}

/// A caller that leaves does not know the outcome; its retry does.
#[tokio::test]
async fn a_batch_whose_caller_left_is_settled_by_its_retry() {
    let (service, uid) = arm("R1").await;
    let (session, _) = open(&service, &uid, 1).await;
    for number in 1..40u64 {
        let request = batch(&session, number, &[Put(session.first, number as f64)]);
        let mut left = Box::pin(service.write(&CALL, request.clone()));
        for _ in 0..number % 8 {
            if poll!(&mut left).is_ready() {
                break;
            }
            tokio::task::yield_now().await;
        }
        drop(left);
        let response = write(&service, request).await;
        assert_eq!(response.revision, revision(&uid, number + 1));
        let points = everything(&service).await.points.unwrap();
        assert_eq!(points.states.unwrap().coordinates, [number as f64]);
        assert_eq!(points.revisions, [number + 1]);
    }
}
