//! Deadlines, dropped calls, and long batches next to short calls.

use std::time::Duration;

use tokio_stream::iter;
use tonic::{Code, Request};
use wayfold_index::Space;
use wayfold_proto::v1::{InsertRequest, KnnRequest, StreamKnnRequest, stream_knn_response};
use wayfold_tests::{
    Content, Refusal, ServerProcess, Signal, States, Stubs, insert_request, k_nearest, knn_request,
    number, server,
};

/// A search in this many dimensions looks at most of the points.
const WIDTH: usize = 16;
const SPACE: &str = "R16";
/// The states of a long batch of searches, which takes more than a second.
const SEARCH_STATES: usize = 10_000;
/// The rows of a long insert that asks for neighbours, which takes as long.
const INSERT_ROWS: usize = 4_000;

async fn filled(rows: usize) -> (ServerProcess, Stubs, States) {
    let server = server!();
    let mut stubs = Stubs::connect(server.uri()).await;
    stubs.create("roadmap", SPACE).await;
    let space: Space = SPACE.parse().expect("a space");
    let mut states = States::new(space, 13);
    for _ in 0..rows / 2_000 {
        stubs.insert(insert(&mut states, 2_000)).await;
    }
    (server, stubs, states)
}

fn insert(states: &mut States, rows: usize) -> InsertRequest {
    insert_request("roadmap", &states.rows(rows), WIDTH)
}

fn knn(states: &mut States, rows: usize) -> KnnRequest {
    knn_request("roadmap", &states.rows(rows), WIDTH, 1)
}

fn within<T>(deadline_ms: u64, message: T) -> Request<T> {
    let mut request = Request::new(message);
    request.set_timeout(Duration::from_millis(deadline_ms));
    request
}

#[tokio::test(flavor = "multi_thread")]
async fn a_mutation_past_its_deadline_is_whole_or_not_there() {
    let (_server, mut stubs, mut states) = filled(4_000).await;
    let mut cut = 0;
    for deadline_ms in [1, 3, 10, 30, 100] {
        let before = stubs.describe("roadmap").await;
        let request = InsertRequest {
            neighbor_spec: Some(k_nearest(1)),
            operation_id: format!("within {deadline_ms} ms"),
            ..insert(&mut states, INSERT_ROWS)
        };
        let timed = stubs
            .points
            .insert(within(deadline_ms, request.clone()))
            .await;
        if let Err(status) = timed {
            // The client's own timer answers CANCELLED, the server's DEADLINE_EXCEEDED.
            assert!(
                matches!(status.code(), Code::DeadlineExceeded | Code::Cancelled),
                "{status:?}"
            );
            cut += 1;
        }
        // The retry takes effect exactly once, after either outcome.
        let answer = stubs.insert(request).await;
        assert_eq!(number(&answer.revision), number(&before.revision) + 1);
        let after = stubs.describe("roadmap").await;
        assert_eq!(after.revision, answer.revision);
        assert_eq!(after.point_count, before.point_count + INSERT_ROWS as u64);
    }
    assert!(cut > 0, "no deadline was short enough");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_dropped_mutation_is_whole_or_not_there() {
    let (_server, mut stubs, mut states) = filled(4_000).await;
    for round in 0..6 {
        let before = stubs.describe("roadmap").await;
        let request = InsertRequest {
            neighbor_spec: Some(k_nearest(1)),
            ..insert(&mut states, INSERT_ROWS)
        };
        let mut other = stubs.clone();
        let call = tokio::spawn(async move { other.insert(request).await });
        // The delay lasts this many answers, so the insert is under way in most rounds.
        for _ in 0..round {
            stubs.points.knn(knn(&mut states, 1)).await.unwrap();
        }
        call.abort();
        let dropped = call.await.is_err();
        // A later mutation of the same index is ordered after it, or finds that it never took effect.
        stubs.insert(insert(&mut states, 1)).await;
        let content = Content::read(&stubs, "roadmap").await.unwrap();
        let stored = content.points.len() as u64 - before.point_count - 1;
        let made = content.revision - number(&before.revision) - 1;
        assert!(
            (stored, made) == (INSERT_ROWS as u64, 1) || dropped && (stored, made) == (0, 0),
            "{stored} rows in {made} revisions of a dropped insert"
        );
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn short_calls_are_answered_while_long_batches_run() {
    let (_server, mut stubs, mut states) = filled(10_000).await;
    // There are more calls than cores.
    let batches = 2 * std::thread::available_parallelism().unwrap().get();
    let mut long = tokio::task::JoinSet::new();
    for _ in 0..batches {
        let request = knn(&mut states, SEARCH_STATES);
        let mut stubs = stubs.clone();
        long.spawn(async move { stubs.points.knn(request).await.unwrap().into_inner() });
    }
    for _ in 0..10 {
        stubs.points.knn(knn(&mut states, 1)).await.unwrap();
        stubs.insert(insert(&mut states, 1)).await;
        assert!(
            long.try_join_next().is_none(),
            "a short call waited for a long one"
        );
    }
    for answer in long.join_all().await {
        assert_eq!(
            answer.neighbors.unwrap().neighbor_counts,
            vec![1; SEARCH_STATES]
        );
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn work_that_nobody_waits_for_is_given_up() {
    let (server, mut stubs, mut states) = filled(10_000).await;
    // The work would take hours without the deadline.
    let requests = vec![
        StreamKnnRequest {
            knn: Some(knn(&mut states, SEARCH_STATES))
        };
        1_000
    ];
    let stream = within(3_000, iter(requests));
    let mut answers = stubs.points.stream_knn(stream).await.unwrap().into_inner();
    let status = loop {
        match answers.message().await {
            Ok(Some(answer)) => match answer.result.unwrap() {
                stream_knn_response::Result::Knn(_) => {}
                stream_knn_response::Result::Error(error) => {
                    assert_eq!(Code::from_i32(error.code), Code::DeadlineExceeded);
                }
            },
            Ok(None) => panic!("a thousand batches were answered within the deadline"),
            Err(status) => break status,
        }
    };
    assert_eq!(status.code(), Code::DeadlineExceeded, "{status:?}");

    // Dropped calls are cancelled too, so the server has nothing left to finish.
    let request = knn(&mut states, SEARCH_STATES);
    let mut dropped = tokio::task::JoinSet::new();
    for _ in 0..100 {
        let (mut stubs, request) = (stubs.clone(), request.clone());
        dropped.spawn(async move { stubs.points.knn(request).await });
    }
    // An answer says that the server has read them, and so does a refusal: they are more than it can do in time.
    if let Err(status) = stubs.points.knn(knn(&mut states, 1)).await {
        assert_eq!(Refusal::of(&status).reason, "OVERLOADED", "{status:?}");
    }
    dropped.shutdown().await;
    drop((answers, stubs));
    let finished = server.stop(Signal::Terminate);
    assert_eq!(finished.status.code(), Some(0), "{}", finished.stderr);
}
