//! A server that is asked to stop finishes accepted calls, refuses new ones, and does not wait without end.

use crate::{
    bare::{Connection, frame},
    harness::{TestServer, connect, insert, knn, nearest, reason},
};
use bytes::Bytes;
use futures_util::{StreamExt, stream};
use tokio::{
    io::{AsyncReadExt, AsyncWriteExt},
    net::TcpStream,
    sync::mpsc,
};
use tonic::{Code, transport::Endpoint};
use tonic_health::pb::{
    HealthCheckRequest, health_check_response::ServingStatus, health_client::HealthClient,
};
use wayfold_proto::v1::{
    self, point_service_client::PointServiceClient, stream_knn_response::Result as Answer,
};
use wayfold_server::ServerError;

/// The number of points. A scan of them does not fit into the buffers on its way.
const POINTS: u64 = 300_000;

fn scan(index: &str) -> v1::ScanRequest {
    v1::ScanRequest {
        index_name: index.into(),
        ..Default::default()
    }
}

fn nearest_to(at: f64) -> v1::StreamKnnRequest {
    v1::StreamKnnRequest {
        knn: Some(knn("line", &[at], 1)),
    }
}

#[tokio::test]
async fn a_scan_under_way_is_finished_while_new_calls_are_refused() {
    let server = TestServer::start(|_| ()).await;
    server.create_ruler("line", POINTS).await;
    let scanned = server.points().scan(scan("line")).await;
    let mut parts = scanned.unwrap().into_inner();
    let first = parts.message().await.unwrap().unwrap();
    let mut ids = first.points.unwrap().ids;

    let address = server.address;
    let other = connect(address).await;
    let mut health = HealthClient::new(other.clone())
        .watch(HealthCheckRequest::default())
        .await
        .unwrap()
        .into_inner();
    let serving = health.message().await.unwrap().unwrap();
    assert_eq!(serving.status(), ServingStatus::Serving);
    let ended = server.stop();
    let stopping = health.message().await.unwrap().unwrap();
    assert_eq!(stopping.status(), ServingStatus::NotServing);
    let refused = PointServiceClient::new(other)
        .knn(knn("line", &[0.0], 1))
        .await;
    assert_eq!(refused.unwrap_err().code(), Code::Unavailable);
    assert!(!ended.is_finished());

    while let Some(part) = parts.message().await.unwrap() {
        ids.extend(part.points.unwrap().ids);
    }
    assert_eq!(ids, (0..POINTS).collect::<Vec<_>>());
    ended.await.unwrap().unwrap();
    let endpoint = Endpoint::from_shared(format!("http://{address}")).unwrap();
    assert!(endpoint.connect().await.is_err());
}

#[tokio::test]
async fn an_open_stream_learns_of_the_stop_and_does_not_delay_it() {
    let server = TestServer::start(|_| ()).await;
    server.create_ruler("line", 10).await;
    let (send, mut receive) = mpsc::channel(1);
    let requests = stream::poll_fn(move |context| receive.poll_recv(context));
    let answers = server.points().stream_knn(requests).await.unwrap();
    let mut answers = answers.into_inner();
    for at in [3, 1, 2] {
        send.send(nearest_to(at as f64)).await.unwrap();
        assert_eq!(nearest(answers.message().await.unwrap().unwrap()), at);
    }
    let ended = server.stop();
    let status = answers.message().await.unwrap_err();
    assert_eq!(reason(&status, Code::Unavailable), "STOPPING");
    ended.await.unwrap().unwrap();
}

#[tokio::test]
async fn requests_that_a_stream_accepted_are_answered_before_it_ends() {
    let server = TestServer::start(|_| ()).await;
    server.create_ruler("line", 10).await;
    let (send, mut receive) = mpsc::channel(1);
    let requests = stream::poll_fn(move |context| receive.poll_recv(context));
    let answers = server.points().stream_knn(requests).await.unwrap();
    let mut answers = answers.into_inner();
    let sending = tokio::spawn(async move {
        let mut sent = 0_u64;
        while send.send(nearest_to((sent % 10) as f64)).await.is_ok() {
            sent += 1;
        }
        sent
    });
    let first = answers.message().await.unwrap().unwrap();
    assert_eq!(nearest(first), 0);
    let ended = server.stop();
    let mut answered = 1;
    let status = loop {
        match answers.message().await {
            Ok(answer) => match answer.unwrap().result.unwrap() {
                Answer::Knn(answer) => {
                    assert_eq!(answer.neighbors.unwrap().ids, [answered % 10]);
                    answered += 1;
                }
                // The request arrived before the stop but was not begun, so it is refused like any new call.
                Answer::Error(status) => assert_eq!(status.code, Code::Unavailable as i32),
            },
            Err(status) => break status,
        }
    };
    assert_eq!(reason(&status, Code::Unavailable), "STOPPING");
    ended.await.unwrap().unwrap();
    assert!(sending.await.unwrap() >= answered);
}

#[tokio::test]
async fn calls_beyond_the_grace_period_are_cut() {
    let server = TestServer::start(|config| config.shutdown.grace_ms = 1).await;
    server.create_ruler("line", POINTS).await;
    let scanned = server.points().scan(scan("line")).await;
    let mut parts = scanned.unwrap().into_inner();
    parts.message().await.unwrap().unwrap();

    // The client reads no further, so the scan cannot end.
    let error = server.stop().await.unwrap().unwrap_err();
    let ServerError::Cut { calls, grace_ms } = error else {
        panic!("{error}");
    };
    assert_eq!((calls, grace_ms), (1, 1));
    let rest: Vec<_> = parts.collect().await;
    assert!(rest.last().unwrap().is_err());
}

/// The clock stands still as in the next test. The client sends no more of its request, or does not read that its `Watch`
/// has ended.
#[tokio::test]
async fn calls_that_only_wait_for_their_client_do_not_delay_a_stop() {
    let watch = frame(&v1::WatchRequest {
        index_name: "line".into(),
        ..Default::default()
    });
    let cut_short = frame(&insert("line", &[0.0])).slice(..4);
    for (rpc, sent) in [
        ("PointService/Watch", watch),
        ("IndexService/RestoreIndex", Bytes::new()),
        ("PointService/Insert", cut_short),
    ] {
        let server = TestServer::start(|config| config.shutdown.grace_ms = 2_000_000_000).await;
        server.create_ruler("line", 10).await;
        let is_watch = rpc == "PointService/Watch";
        let mut connection = match is_watch {
            true => Connection::open_without_window(server.address).await,
            false => Connection::open(server.address).await,
        };
        let request = connection.request(rpc);
        let (answer, mut body) = connection.begin(request).await.unwrap();
        body.send_data(sent, is_watch).unwrap();
        let mut unread = None;
        match is_watch {
            true => unread = Some(answer.await.unwrap()),
            false => connection.expect_call().await,
        }
        let began = tokio::time::Instant::now();
        let ended = server.stop();
        tokio::time::pause();
        ended.await.unwrap().unwrap();
        tokio::time::resume();
        let waited = began.elapsed();
        assert!(waited.as_secs() < 10, "{rpc}: {waited:?}");
        drop((unread, body));
    }
}

/// The clock stands still except while the server waits for a timer. A server that waited for the grace period of
/// several weeks would advance the clock by it and report a failure.
#[tokio::test]
async fn connections_without_calls_whose_peers_are_frozen_are_cut_and_that_is_no_failure() {
    let server = TestServer::start(|config| config.shutdown.grace_ms = 2_000_000_000).await;
    let _silent = TcpStream::connect(server.address).await.unwrap();
    let mut frozen = TcpStream::connect(server.address).await.unwrap();
    // The preface of HTTP/2 with empty settings (RFC 9113, 3.4): after it the client never reads nor writes.
    let preface = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n\0\0\0\x04\0\0\0\0\0";
    frozen.write_all(preface).await.unwrap();
    let mut settings = [0; 9];
    frozen.read_exact(&mut settings).await.unwrap();
    assert_eq!(settings[3], 4, "{settings:?}");

    let began = tokio::time::Instant::now();
    let ended = server.stop();
    tokio::time::pause();
    ended.await.unwrap().unwrap();
    let waited = began.elapsed();
    assert!(waited.as_millis() < 2_000_000_000, "{waited:?}");
}
