//! Calls that panic or do not arrive, and the bytes of answers.

use bytes::Bytes;
use futures_util::{StreamExt, poll, stream};
use http_body::{Body as HttpBody, Frame};
use http_body_util::{BodyExt, Full, StreamBody};
use tokio::time::timeout;
use tokio_util::sync::CancellationToken;
use tonic::Code;
use tonic_types::StatusExt;

use super::*;
use crate::{admission::CallTurns, config::Config, grpc::connections::Connections, log::Uid};

/// Answers with the result of a function, or panics as it does.
#[derive(Clone)]
struct Answering(fn() -> Response<Body>);

impl Service<Request<Body>> for Answering {
    type Response = Response<Body>;
    type Error = Infallible;
    type Future = ResponseFuture;

    fn poll_ready(&mut self, _: &mut Context<'_>) -> Poll<Result<(), Infallible>> {
        Poll::Ready(Ok(()))
    }

    fn call(&mut self, _: Request<Body>) -> ResponseFuture {
        let answer = self.0;
        Box::pin(async move { Ok(answer()) })
    }
}

fn shared() -> FaceContext {
    let service = crate::service::Service::starting(Default::default());
    FaceContext::new(&Config::default(), service, Default::default())
}

async fn call(
    shared: &FaceContext,
    under_way: &TaskTracker,
    answer: fn() -> Response<Body>,
) -> Response<Body> {
    call_path("/wayfold.v1.PointService/Scan", shared, under_way, answer).await
}

async fn call_path(
    path: &str,
    shared: &FaceContext,
    under_way: &TaskTracker,
    answer: fn() -> Response<Body>,
) -> Response<Body> {
    let request = Request::post(path).body(Body::empty());
    let mut calls = calls(shared, under_way, answer);
    calls.call(request.unwrap()).await.unwrap()
}

fn calls(
    shared: &FaceContext,
    under_way: &TaskTracker,
    answer: fn() -> Response<Body>,
) -> Calls<Answering> {
    let layer = CallsLayer::new(
        &Config::default().grpc,
        shared.clone(),
        Callers::Clients,
        under_way.clone(),
    );
    layer.layer(Answering(answer))
}

#[test]
fn more_headers_than_usual_count() {
    let headers = |count| {
        let names = (0..count).map(|number| format!("h{number}").parse().unwrap());
        names.map(|name: header::HeaderName| (name, "".parse().unwrap()))
    };
    let usual = Uri::from_static("/wayfold.v1.PointService/Scan");
    assert_eq!(call_bytes(&usual, &headers(10).collect()), CALL_BYTES);
    assert!(call_bytes(&usual, &headers(240).collect()) > CALL_BYTES + 20_000);
}

#[test]
fn long_headers_and_paths_count() {
    let long = "x".repeat(8_000);
    let headers = ["baggage", "authorization"].map(|name| {
        let name = header::HeaderName::from_static(name);
        (name, long.parse().unwrap())
    });
    let usual = Uri::from_static("/wayfold.v1.PointService/Scan");
    let bytes = call_bytes(&usual, &HeaderMap::from_iter(headers));
    assert!(bytes > CALL_BYTES + 14_000);
    let path = format!("/wayfold.v1.{long}?{long}").parse().unwrap();
    assert!(call_bytes(&path, &HeaderMap::new()) > CALL_BYTES + 14_000);
}

#[tokio::test]
async fn only_a_member_names_the_index_of_a_forwarded_call() {
    let (shared, uid) = (shared(), Uid::unique());
    let mut headers = HeaderMap::new();
    headers.insert(UID, uid.to_string().parse().unwrap());
    for (callers, named) in [(Callers::Clients, None), (Callers::Members, Some(uid))] {
        let layer = CallsLayer::new(
            &Config::default().grpc,
            shared.clone(),
            callers,
            TaskTracker::new(),
        );
        let call = layer.context(&headers, None, &layer.flow(false, None));
        assert_eq!(call.forwarded_uid, named);
    }
}

#[tokio::test]
async fn a_call_that_panics_is_a_bug_and_frees_its_place_and_turn() {
    let (shared, under_way) = (shared(), TaskTracker::new());
    for _ in 0..2 {
        let answer = call(&shared, &under_way, || panic!("a bug")).await;
        let status = Status::from_header_map(answer.headers()).unwrap();
        assert_eq!(status.code(), Code::Internal);
        assert_eq!(status.get_details_error_info().unwrap().reason, "INTERNAL");
        assert!(under_way.is_empty());
    }
}

#[tokio::test]
async fn a_stream_that_panics_ends_as_a_bug_and_frees_its_place_and_turn() {
    let (shared, under_way) = (shared(), TaskTracker::new());
    for _ in 0..2 {
        let answer = call(&shared, &under_way, || {
            let parts = stream::once(async {
                tokio::task::yield_now().await;
                panic!("a bug")
            });
            let encoder = tonic_prost::ProstEncoder::<()>::default();
            let body = tonic::codec::EncodeBody::new_server(
                encoder,
                parts,
                None,
                Default::default(),
                None,
            );
            Response::new(Body::new(body))
        })
        .await;
        assert_eq!(under_way.len(), 1);
        let mut body = answer.into_body();
        let frame = std::future::poll_fn(|context| Pin::new(&mut body).poll_frame(context)).await;
        let trailers = frame.unwrap().unwrap().into_trailers().unwrap();
        let status = Status::from_header_map(&trailers).unwrap();
        assert_eq!(status.code(), Code::Internal);
        assert!(under_way.is_empty());
    }
}

#[tokio::test(start_paused = true)]
async fn a_request_for_health_that_does_not_arrive_is_counted() {
    let shared = shared();
    let connections = Connections::new(1, 1, shared.admission.clone());
    let connection = connections.open(None, CancellationToken::new()).await;
    let never = Body::new(StreamBody::new(stream::pending::<
        Result<Frame<Bytes>, Status>,
    >()));
    let request = Request::post("/grpc.health.v1.Health/Check")
        .extension(connection.unwrap().activity().clone())
        .body(never);
    let mut calls = calls(&shared, &TaskTracker::new(), || panic!("a request"));
    let answer = calls.call(request.unwrap()).await.unwrap();
    let status = Status::from_header_map(answer.headers()).unwrap();
    let reason = status.get_details_error_info().unwrap().reason;
    assert_eq!(reason, "TOO_SLOW");
    assert!(shared.admission.refused(0).contains(&("TOO_SLOW", 1)));
}

#[tokio::test]
async fn the_flow_of_calls_with_short_deadlines_is_hurried() {
    let shared = shared();
    let connections = Connections::new(1, 1, shared.admission.clone());
    let connection = connections.open(None, CancellationToken::new()).await;
    let connection = connection.unwrap();
    let empty = || Response::new(Body::empty());
    let mut calls = calls(&shared, &TaskTracker::new(), empty);
    for (timeout, is_hurried) in [(Some("500m"), true), (Some("5S"), false), (None, false)] {
        let mut request = Request::post("/wayfold.v1.PointService/Knn");
        if let Some(timeout) = timeout {
            request = request.header("grpc-timeout", timeout);
        }
        let request = request.extension(connection.activity().clone());
        let answer = calls.call(request.body(Body::empty()).unwrap()).await;
        answer.unwrap();
        let flow = connection.activity().flow();
        assert_eq!(flow.is_hurried(), is_hurried, "{timeout:?}");
    }
}

/// A client that reads nothing leaves the first frame where it is: the connection asks for it once there is room to send.
#[tokio::test]
async fn an_answer_is_counted_from_the_time_it_is_made() {
    // More than a flow may hold.
    const BYTES: usize = 1 << 28;
    let (shared, under_way) = (shared(), TaskTracker::new());
    let (max, other) = (shared.admission.bytes().1 as usize, shared.admission.open());
    let has_room = || other.hold().take(max / 8);
    assert!(has_room());
    let answer = call(&shared, &under_way, || {
        Response::new(Body::new(Full::new(Bytes::from(vec![0; BYTES]))))
    });
    let answer = answer.await;
    assert!(!has_room());
    drop(answer);
    assert!(has_room());
}

/// The client takes a small frame of an answer, whose call holds more than is left of all bytes.
#[tokio::test(start_paused = true)]
async fn all_bytes_of_a_connection_are_late_while_it_asks_for_no_frame_of_an_answer() {
    const MOST: Duration = Duration::from_secs(60);
    for asks in [false, true] {
        let shared = shared();
        let connections = Connections::new(1, 1, shared.admission.clone());
        let cut = CancellationToken::new();
        let connection = connections.open(None, cut.clone()).await.unwrap();
        let mut calls = calls(&shared, &TaskTracker::new(), || {
            let frame = Ok::<_, Status>(Frame::data(Bytes::from_static(b"part")));
            let parts = stream::iter([frame]).chain(stream::pending());
            Response::new(Body::new(StreamBody::new(parts)))
        });
        let request = Request::post("/wayfold.v1.PointService/Scan")
            .extension(connection.activity().clone())
            .body(Body::empty());
        let mut body = calls.call(request.unwrap()).await.unwrap().into_body();
        let held = connection.activity().flow().hold();
        held.force_take(shared.admission.bytes().1 as usize / 2);
        let _frame = body.frame().await.unwrap().unwrap();
        if asks {
            assert!(poll!(body.frame()).is_pending());
        }
        let looking = connections.cut_waiting(MOST);
        assert!(timeout(MOST / 2, looking).await.is_err());
        assert_eq!(cut.is_cancelled(), !asks);
    }
}

/// The turns of all workers.
fn all_turns(shared: &FaceContext) -> [CallTurns; 2] {
    let flow = shared.admission.open();
    [(); 2].map(|()| {
        let mut turns = flow.turns();
        turns.request().unwrap();
        turns
    })
}

#[tokio::test]
async fn a_path_without_a_call_waits_for_no_turn() {
    let (shared, under_way) = (shared(), TaskTracker::new());
    let _busy = all_turns(&shared);
    let empty = || Response::new(Body::empty());
    for (path, waits) in [
        ("/wayfold.v1.PointService/Knn", true),
        ("/wayfold.v1.PointService/Guess", false),
        ("/wayfold.v1.NoService/Knn", false),
        ("/another.v1.Service/Call", false),
    ] {
        let answer = std::pin::pin!(call_path(path, &shared, &under_way, empty));
        assert_eq!(futures_util::poll!(answer).is_pending(), waits, "{path}");
    }
}

#[tokio::test]
async fn a_call_that_waits_needs_room_at_its_turn() {
    let (shared, under_way) = (shared(), TaskTracker::new());
    let busy = all_turns(&shared);
    let mut answer = std::pin::pin!(call(&shared, &under_way, || Response::new(Body::empty())));
    assert!(futures_util::poll!(answer.as_mut()).is_pending());
    let unread = shared.admission.open().hold();
    unread.force_take(shared.admission.bytes().1 as usize + 1);
    drop(busy);
    let status = Status::from_header_map(answer.await.headers()).unwrap();
    assert_eq!(
        status.get_details_error_info().unwrap().reason,
        "TOO_MANY_BYTES"
    );
}

/// Each connection has one large answer, whose client reads nothing.
#[tokio::test]
async fn many_answers_that_are_not_read_leave_an_eighth_of_all_bytes() {
    const BYTES: usize = 1 << 22;
    let large = || Response::new(Body::new(Full::new(Bytes::from(vec![0; BYTES]))));
    // The answer to a mutation, which took place, is given if the call could begin.
    for (path, eighths) in [("Knn", 7), ("Insert", 8)] {
        let (shared, under_way) = (shared(), TaskTracker::new());
        let path = format!("/wayfold.v1.PointService/{path}");
        let eighth = shared.admission.bytes().1 as usize / 8;
        let mut answers = Vec::new();
        for _ in 0..2 * eighths * eighth / BYTES {
            let answer = call_path(&path, &shared, &under_way, large).await;
            match Status::from_header_map(answer.headers()) {
                Some(refused) => assert_eq!(refused.code(), Code::ResourceExhausted),
                None => answers.push(answer),
            }
        }
        let bytes = answers.len() * BYTES;
        assert!(bytes.abs_diff(eighths * eighth) <= BYTES, "{bytes}");
    }
}
