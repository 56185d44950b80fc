//! Health and reflection serve callers without an identity, and bound what these hold.

use crate::{
    bare::{Connection, frame, status},
    harness::{TestServer, reason},
};
use bytes::Bytes;
use futures_util::{StreamExt, stream::FuturesUnordered};
use http::{StatusCode, header};
use tonic::{Code, Status};
use tonic_health::pb::HealthCheckRequest;
use tonic_reflection::pb::v1::{
    ServerReflectionRequest, server_reflection_request::MessageRequest,
};
use wayfold_proto::v1;

const CHECK: &str = "grpc.health.v1.Health/Check";
const REFLECTION: &str = "grpc.reflection.v1.ServerReflection/ServerReflectionInfo";

fn list_services() -> Bytes {
    frame(&ServerReflectionRequest {
        host: String::new(),
        message_request: Some(MessageRequest::ListServices(String::new())),
    })
}

#[tokio::test]
async fn many_headers_are_refused_and_a_long_token_is_not() {
    let server = TestServer::start(|_| ()).await;
    let mut connection = Connection::open(server.address).await;
    for method in [CHECK, "wayfold.v1.IndexService/GetServer"] {
        let mut request = connection.request_of(method);
        for number in 0..600 {
            request = request.header(format!("h{number}"), "");
        }
        let (answer, _body) = connection.begin(request).await.unwrap();
        let refused = answer.await.unwrap().status();
        assert_eq!(refused, StatusCode::REQUEST_HEADER_FIELDS_TOO_LARGE);
    }
    let token = format!("Bearer {}", "x".repeat(6000));
    let request = connection
        .request("IndexService/GetServer")
        .header(header::AUTHORIZATION, token)
        .header("baggage", "x".repeat(8192));
    let (answer, mut body) = connection.begin(request).await.unwrap();
    body.send_data(frame(&v1::GetServerRequest {}), true)
        .unwrap();
    assert_eq!(status(answer).await.unwrap().code(), Code::Ok);
    server.stop().await.unwrap().unwrap();
}

#[tokio::test]
async fn few_requests_for_health_of_a_connection_are_on_their_way() {
    let server = TestServer::start(|_| ()).await;
    let mut connection = Connection::open(server.address).await;
    let (mut answers, mut bodies) = (FuturesUnordered::new(), Vec::new());
    for _ in 0..5 {
        let request = connection.request_of(CHECK);
        let (answer, body) = connection.begin(request).await.unwrap();
        answers.push(status(answer));
        bodies.push(body);
    }
    let refused = answers.next().await.unwrap().unwrap();
    assert_eq!(reason(&refused, Code::ResourceExhausted), "TOO_MANY_CALLS");
    let whole = frame(&HealthCheckRequest::default());
    // The stream of the refused one has ended.
    let sent = bodies
        .iter_mut()
        .map(|body| body.send_data(whole.clone(), true).is_ok());
    assert!(sent.filter(|sent| *sent).count() >= 4);
    while let Some(answer) = answers.next().await {
        assert_eq!(answer.unwrap().code(), Code::Ok);
    }
    server.stop().await.unwrap().unwrap();
}

#[tokio::test]
async fn a_request_for_health_arrives_in_time() {
    let server = TestServer::start(|config| config.grpc.receive_timeout_ms = 200).await;
    let header = Bytes::from_static(&[0, 0, 0, 0, 9]);
    let whole = frame(&HealthCheckRequest::default());
    for sent in [Bytes::new(), header, whole] {
        let mut connection = Connection::open(server.address).await;
        let request = connection.request_of(CHECK);
        let (answer, mut body) = connection.begin(request).await.unwrap();
        body.send_data(sent, false).unwrap();
        let late = status(answer).await.unwrap();
        assert_eq!(reason(&late, Code::ResourceExhausted), "TOO_SLOW");
    }
    server.stop().await.unwrap().unwrap();
}

/// The server refuses one more stream for reflection.
async fn expect_refusal(connection: &mut Connection) {
    let request = connection.request_of(REFLECTION);
    let (answer, _body) = connection.begin(request).await.unwrap();
    let refused = Status::from_header_map(answer.await.unwrap().headers()).unwrap();
    assert_eq!(reason(&refused, Code::ResourceExhausted), "TOO_MANY_CALLS");
}

#[tokio::test]
async fn few_streams_for_reflection_of_a_connection_are_open() {
    let server = TestServer::start(|_| ()).await;
    let mut connection = Connection::open(server.address).await;
    let mut open = Vec::new();
    for _ in 0..4 {
        let request = connection.request_of(REFLECTION);
        let (answer, body) = connection.begin(request).await.unwrap();
        // Its headers come before the first request.
        open.push((answer.await.unwrap().into_body(), body));
    }
    expect_refusal(&mut connection).await;
    drop(open);
    server.stop().await.unwrap().unwrap();
}

#[tokio::test]
async fn an_unread_answer_of_reflection_keeps_its_place() {
    let server = TestServer::start(|_| ()).await;
    let mut connection = Connection::open_without_window(server.address).await;
    let mut open = Vec::new();
    for _ in 0..4 {
        let request = connection.request_of(REFLECTION);
        let (answer, mut body) = connection.begin(request).await.unwrap();
        body.send_data(list_services(), true).unwrap();
        open.push(answer.await.unwrap());
    }
    expect_refusal(&mut connection).await;
    drop(open);
    server.stop().await.unwrap().unwrap();
}

/// HTTP/2 keeps requests that the service has not read, up to a megabyte for each.
#[tokio::test]
async fn few_streams_for_reflection_of_all_connections_are_open() {
    let server = TestServer::start(|_| ()).await;
    let mut open = Vec::new();
    for _ in 0..8 {
        let mut connection = Connection::open(server.address).await;
        for _ in 0..4 {
            let request = connection.request_of(REFLECTION);
            let (answer, body) = connection.begin(request).await.unwrap();
            open.push((answer.await.unwrap().into_body(), body));
        }
    }
    let mut connection = Connection::open(server.address).await;
    expect_refusal(&mut connection).await;
    drop(open);
    server.stop().await.unwrap().unwrap();
}

#[tokio::test]
async fn a_conversation_with_reflection_goes_on_after_its_first_request() {
    let server = TestServer::start(|_| ()).await;
    let mut connection = Connection::open(server.address).await;
    let request = connection.request_of(REFLECTION);
    let (answer, mut body) = connection.begin(request).await.unwrap();
    let list = list_services();
    body.send_data(list.clone(), false).unwrap();
    let mut answers = answer.await.unwrap().into_body();
    assert!(answers.data().await.unwrap().unwrap().len() > 5);
    body.send_data(list, true).unwrap();
    assert!(answers.data().await.unwrap().unwrap().len() > 5);
    while answers.data().await.is_some() {}
    server.stop().await.unwrap().unwrap();
}
