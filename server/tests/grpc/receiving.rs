//! Parts of requests hold neither the memory of the server nor its places for long.

use crate::{
    bare::{Connection, frame, status},
    harness::{TestServer, insert, knn, reason},
};
use bytes::Bytes;
use futures_util::{
    StreamExt,
    stream::{self, FuturesUnordered},
};
use h2::SendStream;
use tonic::{Code, Status};
use tonic_types::StatusExt;
use wayfold_proto::v1;

/// A quarter of the bytes of all requests is more than a message.
async fn small_server() -> TestServer {
    let server = TestServer::start(|config| {
        config.grpc.max_message_bytes = 100_000;
        config.zenoh.max_message_bytes = 100_000;
        config.admission.max_bytes = 1_100_000;
    });
    let server = server.await;
    server.create_line("line").await;
    server
}

/// A request that lacks its last byte.
fn almost_whole() -> Bytes {
    let mut whole = frame(&insert("line", &[0.0; 10_000]));
    whole.truncate(whole.len() - 1);
    whole
}

fn expect_too_many(status: &Status) {
    assert_eq!(reason(status, Code::ResourceExhausted), "TOO_MANY_BYTES");
    assert!(status.get_details_retry_info().is_some());
}

/// Sends all but the last byte of an insert. Returns its answer and its body.
async fn half_send(
    connection: &mut Connection,
) -> (impl Future<Output = Status> + use<>, SendStream<Bytes>) {
    let request = connection.request("PointService/Insert");
    let (answer, mut body) = connection.begin(request).await.unwrap();
    body.send_data(almost_whole(), false).unwrap();
    (async { status(answer).await.unwrap() }, body)
}

#[tokio::test]
async fn half_sent_requests_of_a_connection_hold_its_share_at_most() {
    let server = small_server().await;
    let mut connection = Connection::open(server.address).await;
    let (mut answers, mut held) = (FuturesUnordered::new(), Vec::new());
    // Three times 88 kB, of which 8 are the call's own, are less than a quarter of 1.1 MB.
    for _ in 0..4 {
        let (answer, body) = half_send(&mut connection).await;
        answers.push(answer);
        held.push(body);
    }
    expect_too_many(&answers.next().await.unwrap());
    // Others have their own share.
    let whole = insert("line", &[0.0; 10_000]);
    server.points().insert(whole.clone()).await.unwrap();
    drop((answers, held));
    // The server reads the ends of the other requests before or after this one.
    loop {
        let request = connection.request("PointService/Insert");
        let (answer, mut body) = connection.begin(request).await.unwrap();
        body.send_data(frame(&whole), true).unwrap();
        match status(answer).await.unwrap() {
            status if status.code() == Code::Ok => break,
            status => expect_too_many(&status),
        }
    }
    server.stop().await.unwrap().unwrap();
}

#[tokio::test]
async fn half_sent_requests_of_all_connections_hold_the_bytes_of_the_server_at_most() {
    let server = small_server().await;
    let (mut answers, mut held) = (FuturesUnordered::new(), Vec::new());
    // Ten times 88 kB fit into seven eighths of 1.1 MB. The last eighth is for connections that hold little, so one is refused.
    for _ in 0..11 {
        let mut connection = Connection::open(server.address).await;
        let (answer, body) = half_send(&mut connection).await;
        answers.push(answer);
        held.push((connection, body));
    }
    expect_too_many(&answers.next().await.unwrap());
    drop((answers, held));
    // The server sees the ends of these connections in its own time.
    let whole = insert("line", &[0.0; 10_000]);
    while let Err(status) = server.points().insert(whole.clone()).await {
        expect_too_many(&status);
    }
    server.stop().await.unwrap().unwrap();
}

/// Calls of headers alone on six connections would hold all bytes, of calls on points or of those on indices.
#[tokio::test]
async fn greedy_connections_leave_room_for_others() {
    let server = small_server().await;
    for (rpc, index) in [
        ("PointService/Insert", "first"),
        ("IndexService/CreateIndex", "second"),
    ] {
        let (mut connections, mut bodies) = (Vec::new(), Vec::new());
        for _ in 0..6 {
            let mut connection = Connection::open(server.address).await;
            let answers = FuturesUnordered::new();
            for _ in 0..32 {
                let request = connection.request(rpc);
                let (answer, body) = connection.begin(request).await.unwrap();
                answers.push(async { status(answer).await.unwrap() });
                bodies.push(body);
            }
            connections.push((connection, answers));
        }
        let (_, answers) = connections.last_mut().unwrap();
        expect_too_many(&answers.next().await.unwrap());
        server.points().knn(knn("line", &[0.0], 1)).await.unwrap();
        server.create_line(index).await;
    }
    server.stop().await.unwrap().unwrap();
}

#[tokio::test]
async fn a_request_that_does_not_arrive_in_time_is_refused() {
    let server = TestServer::start(|config| config.grpc.receive_timeout_ms = 200).await;
    server.create_line("line").await;
    let whole = almost_whole();
    // A stream may pause between its messages, and not within one.
    for (rpc, sent) in [
        ("PointService/Insert", 0),
        ("PointService/Insert", whole.len()),
        ("PointService/StreamKnn", 3),
    ] {
        let mut connection = Connection::open(server.address).await;
        let request = connection.request(rpc);
        let (answer, mut body) = connection.begin(request).await.unwrap();
        body.send_data(whole.slice(..sent), false).unwrap();
        let status = status(answer).await.unwrap();
        assert_eq!(
            reason(&status, Code::ResourceExhausted),
            "TOO_SLOW",
            "{rpc}"
        );
    }
    server.stop().await.unwrap().unwrap();
}

#[tokio::test]
async fn a_stream_holds_its_unfinished_message_only() {
    let server = small_server().await;
    let request = v1::StreamKnnRequest {
        knn: Some(knn("line", &[0.0; 10_000], 1)),
    };
    let requests = vec![request; 50];
    let answers = server.points().stream_knn(stream::iter(requests)).await;
    let mut answers = answers.unwrap().into_inner();
    let mut count = 0;
    while answers.message().await.unwrap().is_some() {
        count += 1;
    }
    assert_eq!(count, 50);
    server.stop().await.unwrap().unwrap();
}
