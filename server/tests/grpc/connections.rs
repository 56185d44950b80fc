//! A client that holds connections does not lock others out.
//!
//! These clients speak bare HTTP/2: tonic's would hide that a connection ended by making another.

use std::net::SocketAddr;

use crate::{
    bare::{Connection, frame, status},
    harness::{TestServer, connect, insert, knn, reason},
};
use futures_util::future::{join_all, try_join_all};
use h2::Reason;
use tokio::{net::TcpStream, sync::mpsc};
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Code, transport::Channel};
use tonic_types::StatusExt;
use wayfold_proto::v1::{self, point_service_client::PointServiceClient};

async fn server_for(connections: usize) -> TestServer {
    TestServer::start(|config| config.grpc.max_connections = connections).await
}

/// A connection with a call under way: a stream of an index's mutations.
struct Watcher {
    client: PointServiceClient<Channel>,
    mutations: tonic::Streaming<v1::WatchResponse>,
}

impl Watcher {
    async fn start(address: SocketAddr) -> Self {
        let mut client = PointServiceClient::new(connect(address).await);
        let request = v1::WatchRequest {
            index_name: "line".into(),
            ..Default::default()
        };
        let mut mutations = client.watch(request).await.unwrap().into_inner();
        mutations.message().await.unwrap().unwrap();
        Self { client, mutations }
    }

    /// Inserts a point over the same connection, which the stream then names.
    async fn expect_insert(&mut self) {
        self.client.insert(insert("line", &[0.0])).await.unwrap();
        let message = self.mutations.message().await.unwrap().unwrap();
        assert_eq!(message.mutations.len(), 1);
    }
}

/// Watch and StreamKnn have three of four places: a fourth stream is refused, and a call that ends is answered.
#[tokio::test]
async fn lasting_streams_leave_places_to_other_calls() {
    let server = TestServer::start(|config| config.grpc.max_calls_per_connection = 4).await;
    server.create_line("line").await;
    let watch = async || {
        let request = v1::WatchRequest {
            index_name: "line".into(),
            ..Default::default()
        };
        server.points().watch(request).await
    };
    let _watches = [watch().await.unwrap(), watch().await.unwrap()];
    let (requests, queue) = mpsc::channel::<v1::StreamKnnRequest>(1);
    let answers = server.points().stream_knn(ReceiverStream::new(queue)).await;
    let refused = watch().await.unwrap_err();
    assert_eq!(reason(&refused, Code::ResourceExhausted), "TOO_MANY_CALLS");
    let expected = "grpc.max_calls_per_connection = 4: open another connection";
    assert!(refused.message().contains(expected), "{refused}");
    let violations = refused.get_details_quota_failure().unwrap().violations;
    assert_eq!(violations[0].quota_value, 4);
    let inserted = server.points().insert(insert("line", &[0.5])).await;
    inserted.unwrap();

    drop(requests);
    assert!(
        answers
            .unwrap()
            .into_inner()
            .message()
            .await
            .unwrap()
            .is_none()
    );
    watch().await.unwrap();
    server.stop().await.unwrap().unwrap();
}

#[tokio::test]
async fn silent_connections_make_room_for_others_and_those_that_called_stay() {
    let server = server_for(8).await;
    let mut old = Connection::open(server.address).await;
    old.expect_call().await;
    let silent = (0..32).map(|_| TcpStream::connect(server.address));
    let _silent = try_join_all(silent).await.unwrap();
    let prefaces = (0..32).map(|_| Connection::open(server.address));
    let _prefaces = join_all(prefaces).await;
    Connection::open(server.address).await.expect_call().await;
    old.expect_call().await;
    server.stop().await.unwrap().unwrap();
}

#[tokio::test]
async fn the_connection_whose_last_call_is_longest_ago_makes_room() {
    // One of the places is the harness's.
    let server = server_for(3).await;
    let mut first = Connection::open(server.address).await;
    let mut second = Connection::open(server.address).await;
    first.expect_call().await;
    second.expect_call().await;
    first.expect_call().await;
    // It gets the harness's place.
    let mut third = Connection::open(server.address).await;
    third.expect_call().await;
    let mut fourth = Connection::open(server.address).await;
    fourth.expect_call().await;
    assert!(second.call().await.is_err());
    first.expect_call().await;
    server.stop().await.unwrap().unwrap();
}

#[tokio::test]
async fn a_connection_waits_while_all_others_have_calls_under_way() {
    let server = server_for(3).await;
    server.create_line("line").await;
    let mut first = Watcher::start(server.address).await;
    let second = Watcher::start(server.address).await;
    // It gets the harness's place.
    let third = Watcher::start(server.address).await;
    let mut client = PointServiceClient::new(connect(server.address).await);
    let waiting = tokio::spawn(async move { client.knn(knn("line", &[0.0], 1)).await });
    first.expect_insert().await;
    assert!(!waiting.is_finished());
    drop(second);
    waiting.await.unwrap().unwrap();
    let Watcher { mut mutations, .. } = third;
    mutations.message().await.unwrap().unwrap();
    server.stop().await.unwrap().unwrap();
}

#[tokio::test]
async fn a_call_is_answered_though_another_connection_waits_for_its_place() {
    let server = server_for(2).await;
    server.create_line("line").await;
    let _watcher = Watcher::start(server.address).await;
    // It gets the harness's place.
    let mut busy = Connection::open(server.address).await;
    busy.expect_call().await;
    let request = busy.request("PointService/Insert");
    let (answer, mut body) = busy.begin(request).await.unwrap();
    let whole = frame(&insert("line", &[0.0]));
    body.send_data(whole.slice(..5), false).unwrap();
    let mut client = PointServiceClient::new(connect(server.address).await);
    let waiting = tokio::spawn(async move { client.knn(knn("line", &[0.0], 1)).await });
    busy.expect_call().await;
    assert!(!waiting.is_finished());
    body.send_data(whole.slice(5..), true).unwrap();
    assert_eq!(status(answer).await.unwrap().code(), Code::Ok);
    waiting.await.unwrap().unwrap();
    server.stop().await.unwrap().unwrap();
}

#[tokio::test]
async fn a_client_that_cancels_all_its_calls_keeps_its_connection() {
    let server = TestServer::start(|_| ()).await;
    let mut connection = Connection::open(server.address).await;
    connection.expect_call().await;
    for _ in 0..200 {
        let request = connection.request("PointService/Knn");
        let (_answer, mut body) = connection.begin(request).await.unwrap();
        body.send_reset(Reason::CANCEL);
    }
    connection.expect_call().await;
    server.stop().await.unwrap().unwrap();
}

/// The answer is larger than the window of HTTP/2, and the client makes no room for the rest.
#[tokio::test]
async fn a_client_that_reads_none_of_its_answer_is_cut() {
    let server = TestServer::start(|config| config.grpc.send_timeout_ms = 100).await;
    server.create_ruler("ruler", 10_000).await;
    let mut connection = Connection::open(server.address).await;
    let request = connection.request("PointService/Knn");
    let (answer, mut body) = connection.begin(request).await.unwrap();
    let whole = frame(&knn("ruler", &[0.0], 10_000));
    body.send_data(whole, true).unwrap();
    let mut answer = answer.await.unwrap().into_body();
    let mut received = 0;
    let end = loop {
        match answer.data().await {
            Some(Ok(bytes)) => received += bytes.len(),
            end => break end,
        }
    };
    assert!(
        matches!(end, Some(Err(_))),
        "{end:?} after {received} bytes"
    );
    assert!(received < 16 * 10_000);
    Connection::open(server.address).await.expect_call().await;
    server.stop().await.unwrap().unwrap();
}
