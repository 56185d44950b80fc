//! The server enforces the deadline that a request's headers name.
//!
//! tonic's client enforces it too and hides the server's answer, so these requests go over bare HTTP/2.

use crate::{
    bare::{Connection, frame, status},
    harness::{TestServer, knn, reason},
};
use bytes::Bytes;
use h2::{SendStream, client::ResponseFuture};
use std::time::Duration;
use tokio::time::timeout;
use tonic::Code;
use wayfold_proto::v1;

/// Far more than the server needs: a test ends by it instead of the default deadline.
const GUARD: Duration = Duration::from_secs(30);

/// Begins a call with a `grpc-timeout`; its messages go into the stream.
async fn begin(
    server: &TestServer,
    rpc: &str,
    timeout: &str,
) -> (ResponseFuture, SendStream<Bytes>) {
    let mut connection = Connection::open(server.address).await;
    let request = connection.request(rpc).header("grpc-timeout", timeout);
    connection.begin(request).await.unwrap()
}

#[tokio::test]
async fn a_call_whose_request_never_arrives_ends_at_its_deadline() {
    let server = TestServer::start(|_| ()).await;
    let (answer, _request) = begin(&server, "PointService/Knn", "20m").await;
    let status = status(answer).await.unwrap();
    assert_eq!(reason(&status, Code::DeadlineExceeded), "DEADLINE_EXCEEDED");
    server.stop().await.unwrap().unwrap();
}

#[tokio::test]
async fn a_read_that_waits_for_a_revision_ends_at_its_deadline() {
    let server = TestServer::start(|_| ()).await;
    let index = server.create_line("line").await;
    let mut wait = knn("line", &[0.0], 1);
    wait.min_revision = index
        .revision
        .map(|empty| v1::Revision { number: 1, ..empty });
    let (answer, mut request) = begin(&server, "PointService/Knn", "20m").await;
    request.send_data(frame(&wait), true).unwrap();
    let status = status(answer).await.unwrap();
    assert_eq!(reason(&status, Code::DeadlineExceeded), "DEADLINE_EXCEEDED");
    server.stop().await.unwrap().unwrap();
}

#[tokio::test]
async fn a_read_without_a_deadline_waits_for_a_revision_no_longer_than_the_contract_says() {
    let server = TestServer::start(|config| {
        config.grpc.default_timeout_ms = 3_600_000;
        config.limits.min_revision_wait = Duration::from_millis(20);
    })
    .await;
    let index = server.create_line("line").await;
    let mut wait = knn("line", &[0.0], 1);
    wait.min_revision = index
        .revision
        .map(|empty| v1::Revision { number: 1, ..empty });
    let mut connection = Connection::open(server.address).await;
    let request = connection.request("PointService/Knn");
    let (answer, mut request) = connection.begin(request).await.unwrap();
    request.send_data(frame(&wait), true).unwrap();
    let status = timeout(GUARD, status(answer)).await.expect("no answer");
    let status = status.unwrap();
    assert_eq!(reason(&status, Code::DeadlineExceeded), "DEADLINE_EXCEEDED");
    server.stop().await.unwrap().unwrap();
}

#[tokio::test]
async fn a_deadline_holds_for_a_whole_stream() {
    let server = TestServer::start(|_| ()).await;
    server.create_ruler("line", 3).await;
    let (answer, mut request) = begin(&server, "PointService/StreamKnn", "200m").await;
    let one = v1::StreamKnnRequest {
        knn: Some(knn("line", &[0.0], 1)),
    };
    request.send_data(frame(&one), false).unwrap();
    let status = status(answer).await.unwrap();
    assert_eq!(reason(&status, Code::DeadlineExceeded), "DEADLINE_EXCEEDED");
    server.stop().await.unwrap().unwrap();
}

#[tokio::test]
async fn a_deadline_that_is_far_away_changes_nothing() {
    let server = TestServer::start(|_| ()).await;
    server.create_ruler("line", 3).await;
    for timeout in ["10S", "99999999H"] {
        let (answer, mut request) = begin(&server, "PointService/Knn", timeout).await;
        let knn = knn("line", &[0.0], 1);
        request.send_data(frame(&knn), true).unwrap();
        assert_eq!(status(answer).await.unwrap().code(), Code::Ok, "{timeout}");
    }
    server.stop().await.unwrap().unwrap();
}

#[tokio::test]
async fn a_deadline_that_cannot_be_read_is_refused() {
    let server = TestServer::start(|_| ()).await;
    let (answer, _request) = begin(&server, "PointService/Knn", "5 seconds").await;
    let status = status(answer).await.unwrap();
    assert_eq!(reason(&status, Code::InvalidArgument), "MALFORMED_TIMEOUT");
    server.stop().await.unwrap().unwrap();
}

#[tokio::test]
async fn a_stream_has_no_default_deadline() {
    let server = TestServer::start(|config| config.grpc.default_timeout_ms = 200).await;
    let index = server.create_line("line").await;
    let request = v1::ScanRequest {
        index_name: "line".into(),
        min_revision: index
            .revision
            .map(|empty| v1::Revision { number: 1, ..empty }),
        ..Default::default()
    };
    let mut points = server.points();
    let mut scanning = tokio::spawn(async move { points.scan(request).await.map(|_| ()) });
    let waited = timeout(Duration::from_millis(600), &mut scanning).await;
    assert!(waited.is_err(), "the scan ended before its revision");
    let row = v1::InsertRequest {
        index_name: "line".into(),
        states: Some(v1::States {
            row_count: 1,
            coordinates: vec![0.5],
        }),
        ..Default::default()
    };
    server.points().insert(row).await.unwrap();
    scanning.await.unwrap().unwrap();
    server.stop().await.unwrap().unwrap();
}
