//! Starting and stopping: a stopping server finishes what it accepted, and takes nothing more.

use std::{
    io::{Read, Write},
    net::TcpStream,
    path::Path,
    process::Command,
    thread,
};

use tonic::{Code, Streaming, transport::Channel};
use tonic_health::pb::{
    HealthCheckRequest, HealthCheckResponse, health_check_response::ServingStatus,
    health_client::HealthClient,
};
use wayfold_index::Space;
use wayfold_proto::v1::{KnnRequest, ScanRequest};
use wayfold_tests::{
    Process, ServerProcess, Signal, States, Stubs, insert_request, knn_request,
    nats::member_settings, page, server,
};

const ROWS: usize = 1_000;
const BATCHES: usize = 20;

async fn filled(stubs: &mut Stubs) -> States {
    stubs.create("roadmap", "R3*SO3:0.15").await;
    let mut states = States::new(Space::se3(), 11);
    for _ in 0..BATCHES {
        let request = insert_request("roadmap", &states.rows(ROWS), 7);
        stubs.insert(request).await;
    }
    states
}

fn knn(states: &mut States, rows: usize) -> KnnRequest {
    knn_request("roadmap", &states.rows(rows), 7, 100)
}

/// A watch on the server's health, which has said that it serves.
async fn serving(uri: &str) -> Streaming<HealthCheckResponse> {
    let channel = Channel::from_shared(uri.to_owned()).unwrap();
    let mut health = HealthClient::new(channel.connect().await.unwrap());
    let request = HealthCheckRequest::default();
    let mut watch = health.watch(request).await.unwrap().into_inner();
    let first = watch.message().await.unwrap().unwrap();
    assert_eq!(first.status(), ServingStatus::Serving);
    watch
}

#[tokio::test]
async fn accepted_calls_finish_after_sigterm() {
    stops_gracefully(Signal::Terminate).await;
}

/// With `none`, only an orderly stop keeps the mutations: also of a server at which an operator looks, and of one that still
/// reads its points.
#[tokio::test]
async fn an_orderly_stop_keeps_the_mutations_while_a_page_is_open_and_before_it_serves() {
    let directory = tempfile::tempdir().unwrap();
    let start = || {
        let mut command = Command::new(env!("CARGO_BIN_EXE_server-process"));
        command
            .args(["--grpc", "127.0.0.1:0", "--http", "127.0.0.1:0", "--data"])
            .arg(directory.path())
            .args(["--zenoh", "tcp/127.0.0.1:0", "--log", "info"])
            .env("WAYFOLD_DATA__DURABILITY", "none");
        Process::spawn(&mut command)
    };
    let mut server = ServerProcess::ready(start());
    let mut stubs = Stubs::connect(server.uri()).await;
    filled(&mut stubs).await;
    let stored = stubs.describe("roadmap").await;
    server.zenoh();
    let pages = server.pages();
    assert_eq!(page(&pages, "/metrics", "").0, 200);
    let mut open = TcpStream::connect(&pages).unwrap();
    open.write_all(b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n")
        .unwrap();
    assert_ne!(open.read(&mut [0; 64]).unwrap(), 0);
    let finished = server.stop(Signal::Terminate);
    assert_eq!(finished.status.code(), Some(0), "{}", finished.stderr);

    let mut reading = start();
    reading.log_until("opened the log");
    let finished = reading.stop(Signal::Terminate);
    assert_eq!(finished.status.code(), Some(0), "{}", finished.stderr);

    let server = ServerProcess::ready(start());
    let again = Stubs::connect(server.uri()).await.describe("roadmap").await;
    assert_eq!(
        (again.revision, again.point_count),
        (stored.revision, stored.point_count)
    );
    drop(open);
}

/// The server waits for the rest of a request to its pages, and answers it.
#[test]
fn an_accepted_call_of_the_pages_is_answered_after_sigterm() {
    let mut server = server!("--http", "127.0.0.1:0");
    let mut call = TcpStream::connect(server.pages()).unwrap();
    let head = "POST /api/v1/list HTTP/1.1\r\nHost: localhost\r\nContent-Length: 2\r\nConnection: close\r\n\
        Expect: 100-continue\r\n\r\n";
    call.write_all(head.as_bytes()).unwrap();
    let mut accepted = [0; 25];
    call.read_exact(&mut accepted).unwrap();
    assert_eq!(&accepted, b"HTTP/1.1 100 Continue\r\n\r\n");
    server.process().signal(Signal::Terminate);
    while TcpStream::connect(server.uri().trim_start_matches("http://")).is_ok() {
        thread::yield_now();
    }
    call.write_all(b"{}").unwrap();
    let mut answer = String::new();
    call.read_to_string(&mut answer).unwrap();
    assert!(answer.starts_with("HTTP/1.1 503"), "{answer}");
    assert!(answer.contains("STOPPING"), "{answer}");
    let finished = server.finish();
    assert_eq!(finished.status.code(), Some(0), "{}", finished.stderr);
}

/// Its router does not answer, and Zenoh waits for it.
#[test]
fn sigterm_ends_a_server_that_waits_for_zenoh() {
    // Nothing listens there, and Zenoh tries again and again.
    let config =
        "{ connect: { endpoints: ['tcp/127.0.0.1:1'], timeout_ms: -1, exit_on_failure: true } }";
    let mut command = Command::new(env!("CARGO_BIN_EXE_server-process"));
    command
        .args(["--grpc", "127.0.0.1:0", "--zenoh", "tcp/127.0.0.1:0"])
        .args(["--log", "info,zenoh=info", "--data", "memory"])
        .env("WAYFOLD_ZENOH__CONFIG", config);
    let mut waiting = Process::spawn(&mut command);
    waiting.log_until("Using ZID");
    let finished = waiting.stop(Signal::Terminate);
    assert_eq!(finished.status.code(), Some(0), "{}", finished.stderr);
}

/// Its store is open and its journal is not.
#[test]
fn sigterm_ends_a_server_that_waits_for_nats() {
    let directory = tempfile::tempdir().unwrap();
    for data in [Path::new("memory"), directory.path()] {
        let mut command = Command::new(env!("CARGO_BIN_EXE_server-process"));
        command
            .args(["--grpc", "127.0.0.1:0", "--log", "info", "--data"])
            .arg(data)
            // Nothing listens there.
            .envs(member_settings("nats://127.0.0.1:1", 1));
        let mut waiting = Process::spawn(&mut command);
        waiting.log_until("trying again");
        let finished = waiting.stop(Signal::Terminate);
        assert_eq!(finished.status.code(), Some(0), "{}", finished.stderr);
        assert!(!finished.stderr.contains("panicked"), "{}", finished.stderr);
    }
}

#[tokio::test]
async fn accepted_calls_finish_after_ctrl_c() {
    stops_gracefully(Signal::Interrupt).await;
}

async fn stops_gracefully(signal: Signal) {
    let server = server!();
    let mut stubs = Stubs::connect(server.uri()).await;
    let mut states = filled(&mut stubs).await;
    let mut health = serving(server.uri()).await;

    // The scan is larger than the connection, so the server sends ahead; the client has read one part.
    let scan = ScanRequest {
        index_name: "roadmap".into(),
        ..Default::default()
    };
    let mut parts = stubs.points.scan(scan).await.unwrap().into_inner();
    let part = parts.message().await.unwrap().unwrap();
    let mut scanned = part.points.unwrap().ids.len();
    assert!(scanned < BATCHES * ROWS);
    // The batch is accepted once later calls on the same connection are answered.
    let batch = knn(&mut states, ROWS);
    let mut other = stubs.clone();
    let batch = tokio::spawn(async move { other.points.knn(batch).await });
    tokio::task::yield_now().await;
    for _ in 0..50 {
        stubs.points.knn(knn(&mut states, 1)).await.unwrap();
    }

    server.process().signal(signal);
    // The health service reports the stop before any call is refused.
    while let Ok(Some(status)) = health.message().await {
        if status.status() != ServingStatus::Serving {
            break;
        }
    }
    let refused = stubs.points.knn(knn(&mut states, 1)).await.unwrap_err();
    // The server answers UNAVAILABLE; the client answers CANCELLED when its connection takes no more calls.
    assert!(
        matches!(refused.code(), Code::Unavailable | Code::Cancelled),
        "{refused:?}"
    );

    let answered = batch.await.unwrap().unwrap().into_inner();
    let neighbors = answered.neighbors.unwrap();
    assert_eq!(neighbors.neighbor_counts, vec![100; ROWS]);
    while let Some(part) = parts.message().await.unwrap() {
        scanned += part.points.unwrap().ids.len();
    }
    assert_eq!(scanned, BATCHES * ROWS);
    drop((parts, health, stubs));
    let finished = server.finish();
    assert_eq!(finished.status.code(), Some(0), "{}", finished.stderr);
}

#[tokio::test]
async fn an_idle_connection_does_not_keep_the_server() {
    let server = server!();
    let mut stubs = Stubs::connect(server.uri()).await;
    stubs.create("roadmap", "R2").await;
    // This runs on another task, so that the connection can receive the server's GOAWAY.
    let stopped = tokio::task::spawn_blocking(|| server.stop(Signal::Terminate));
    let finished = stopped.await.unwrap();
    assert_eq!(finished.status.code(), Some(0), "{}", finished.stderr);
}
