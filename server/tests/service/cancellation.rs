//! Cancelled calls and long calls.

use std::{
    pin::Pin,
    task::Poll,
    time::{Duration, Instant},
};

use futures_util::poll;
use wayfold_proto::v1;
use wayfold_server::service::{Call, Code, Error, Service};

use crate::support::*;

/// An insert that takes many slices to evaluate.
fn long_insertion() -> v1::InsertRequest {
    v1::InsertRequest {
        min_separation: 1e-9,
        ..insertion(&cube(2, 60_000), &[])
    }
}

/// True if a call waits. One that has only used up its slice of time goes on when it is polled again.
async fn waits<T>(call: &mut Pin<Box<impl Future<Output = T>>>) -> bool {
    for _ in 0..10 {
        if poll!(&mut *call).is_ready() {
            return false;
        }
    }
    true
}

/// Polls `long` until it holds the writer, so that a short insert has to wait. Returns that insert.
pub(crate) async fn poll_into_evaluation<'a, T>(
    service: &'a Service,
    long: &mut Pin<Box<impl Future<Output = T>>>,
) -> Pin<Box<dyn Future<Output = Result<v1::InsertResponse, Error>> + 'a>> {
    loop {
        // Without this, tokio's cooperative budget makes a ready call return Pending after 128 polls.
        tokio::task::yield_now().await;
        assert!(
            poll!(&mut *long).is_pending(),
            "the long call is not long enough"
        );
        let mut unchanged = Box::pin(service.remove(&CALL, removal(&[1 << 40])));
        if waits(&mut unchanged).await {
            let mut short = Box::pin(service.insert(&CALL, insertion(&[[9.0; 3]], &[])));
            drop(unchanged);
            assert!(poll!(&mut short).is_pending());
            return short;
        }
    }
}

#[tokio::test]
async fn a_call_dropped_while_it_is_evaluated_changes_nothing() {
    let (service, _) = arm("R3").await;
    let mut long = Box::pin(service.insert(&CALL, long_insertion()));
    let short = poll_into_evaluation(&service, &mut long).await;
    drop(long);
    // The writer is free again and has stored none of the evaluated rows.
    let response = short.await.unwrap();
    assert_eq!((response.revision.number(), response.ids), (1, vec![0]));
    assert_eq!(everything(&service).await.point_count, 1);
}

/// Polls until the deadline, and returns the outcome of the call.
async fn past<T>(deadline: Instant, long: impl Future<Output = T>) -> T {
    let mut long = Box::pin(long);
    while Instant::now() < deadline {
        if let Poll::Ready(answer) = poll!(&mut long) {
            return answer;
        }
    }
    long.await
}

#[tokio::test]
async fn a_deadline_is_kept_inside_a_long_batch() {
    let (service, _) = arm("R3").await;
    let request = long_insertion();
    let (call, deadline) = in_20_ms();
    let answer = past(deadline, service.insert(&call, request)).await;
    assert_eq!(refusal(answer).0, Code::DeadlineExceeded);
    assert_eq!(info(&service, "arm").await.revision.number(), 0);

    insert_rows(&service, &cube(3, 20_000), &[]).await;
    let request = knn(&cube(4, 60_000), 1);
    let (call, deadline) = in_20_ms();
    let answer = past(deadline, service.knn(&call, request)).await;
    assert_eq!(refusal(answer).0, Code::DeadlineExceeded);
}

fn in_20_ms() -> (Call, Instant) {
    let deadline = Instant::now() + Duration::from_millis(20);
    let call = Call {
        deadline: Some(deadline),
        ..Call::default()
    };
    (call, deadline)
}

/// The clock jumps ahead whenever no task can run.
#[tokio::test(start_paused = true)]
async fn a_deadline_ends_the_wait_for_the_writer() {
    let (service, _) = arm("R3").await;
    let mut long = Box::pin(service.insert(&CALL, long_insertion()));
    drop(poll_into_evaluation(&service, &mut long).await);
    let call = Call {
        deadline: Some(Instant::now() + Duration::from_secs(3600)),
        ..Call::default()
    };
    let answer = service.insert(&call, insertion(&[[1.0; 3]], &[])).await;
    assert_eq!(refusal(answer).0, Code::DeadlineExceeded);
}

#[tokio::test]
async fn a_call_whose_deadline_has_passed_does_nothing() {
    let (service, _) = arm("R3").await;
    let call = Call {
        deadline: Some(Instant::now()),
        ..Call::default()
    };
    let answer = service.insert(&call, insertion(&[[1.0; 3]], &[])).await;
    assert_eq!(refusal(answer).0, Code::DeadlineExceeded);
    assert_eq!(info(&service, "arm").await.revision.number(), 0);
}

/// All calls share one thread, so a call that never yields would starve the others.
#[tokio::test(flavor = "current_thread")]
async fn long_batches_let_short_calls_pass() {
    let (service, _) = arm("R3").await;
    insert_rows(&service, &cube(3, 1000), &[]).await;
    let inserting = tokio::spawn({
        let service = service.clone();
        async move { service.insert(&CALL, long_insertion()).await }
    });
    let searching = tokio::spawn({
        let service = service.clone();
        async move { service.knn(&CALL, knn(&cube(4, 60_000), 1)).await }
    });
    let mut short = 0;
    while !inserting.is_finished() && !searching.is_finished() {
        service.knn(&CALL, knn(&[[0.5; 3]], 1)).await.unwrap();
        short += 1;
        tokio::task::yield_now().await;
    }
    assert!(short >= 10, "{short}");
    inserting.await.unwrap().unwrap();
    searching.await.unwrap().unwrap();
}
