//! The server enforces the deadline that a request's headers name.
//!
//! tonic's client enforces it too and hides the server's answer, so these requests go over bare HTTP/2.

use crate::harness::{TestServer, knn, reason};
use bytes::{BufMut, Bytes, BytesMut};
use h2::{SendStream, client::ResponseFuture};
use http::{Request, header};
use prost::Message;
use tokio::net::TcpStream;
use tonic::{Code, Status};
use wayfold_proto::v1;

/// Begins a call with a `grpc-timeout`; its messages go into the stream.
async fn begin(
    server: &TestServer,
    rpc: &str,
    timeout: &str,
) -> (ResponseFuture, SendStream<Bytes>) {
    let socket = TcpStream::connect(server.address).await.unwrap();
    let (client, connection) = h2::client::handshake(socket).await.unwrap();
    tokio::spawn(connection);
    let request = Request::post(format!("http://{}/wayfold.v1.{rpc}", server.address))
        .header(header::CONTENT_TYPE, "application/grpc")
        .header(header::TE, "trailers")
        .header("grpc-timeout", timeout)
        .body(())
        .unwrap();
    client
        .ready()
        .await
        .unwrap()
        .send_request(request, false)
        .unwrap()
}

fn frame(message: &impl Message) -> Bytes {
    let mut frame = BytesMut::new();
    frame.put_u8(0);
    frame.put_u32(message.encoded_len() as u32);
    message.encode(&mut frame).unwrap();
    frame.freeze()
}

/// The status of an answer, from its trailers or, where there is no message, from its headers.
async fn status(answer: ResponseFuture) -> Status {
    let answer = answer.await.unwrap();
    if let Some(status) = Status::from_header_map(answer.headers()) {
        return status;
    }
    let mut body = answer.into_body();
    while let Some(bytes) = body.data().await {
        let length = bytes.unwrap().len();
        body.flow_control().release_capacity(length).unwrap();
    }
    let trailers = body.trailers().await.unwrap().unwrap();
    Status::from_header_map(&trailers).unwrap()
}

#[tokio::test]
async fn a_call_whose_request_never_arrives_ends_at_its_deadline() {
    let server = TestServer::start(|_| ()).await;
    let (answer, _request) = begin(&server, "PointService/Knn", "20m").await;
    let status = status(answer).await;
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
    let status = status(answer).await;
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
    let status = status(answer).await;
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
        assert_eq!(status(answer).await.code(), Code::Ok, "{timeout}");
    }
    server.stop().await.unwrap().unwrap();
}

#[tokio::test]
async fn a_deadline_that_cannot_be_read_is_refused() {
    let server = TestServer::start(|_| ()).await;
    let (answer, _request) = begin(&server, "PointService/Knn", "5 seconds").await;
    let status = status(answer).await;
    assert_eq!(reason(&status, Code::InvalidArgument), "MALFORMED_TIMEOUT");
    server.stop().await.unwrap().unwrap();
}
