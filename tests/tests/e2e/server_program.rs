//! The server as a program: its output, its reaction to signals, and its exit status.

use std::{fs, net::TcpListener, thread};

use futures_util::poll;
use tokio_stream::pending;
use tonic::{Code, Request, transport::Channel};
use tonic_reflection::pb::v1::server_reflection_client::ServerReflectionClient;
use wayfold::{Client, Error, Index, Space, in_trace};
use wayfold_proto::v1;
use wayfold_tests::{
    Process, ProcessOutput, ServerProcess, Signal, Stubs, measuring, revision, row_states, server,
};

const TRACE: &str = "4bf92f3577b34da6a3ce929d0e0e4736";
const TRACEPARENT: &str = "00-4bf92f3577b34da6a3ce929d0e0e4736-00f067aa0ba902b7-01";

async fn reflection(server: &ServerProcess) -> ServerReflectionClient<Channel> {
    let channel = Channel::from_shared(server.uri().to_owned()).unwrap();
    ServerReflectionClient::new(channel.connect().await.unwrap())
}

#[test]
fn it_says_what_to_type_next_and_stops_on_either_signal() {
    for signal in [Signal::Terminate, Signal::Interrupt] {
        let server = server!();
        let hint = format!("--server {} create", server.uri());
        let finished = server.stop(signal);
        assert_eq!(finished.status.code(), Some(0), "{}", finished.stderr);
        let stdout = finished.stdout.join("\n");
        assert!(stdout.contains(&hint), "{stdout}");
        assert!(finished.stderr.contains("stopped"), "{}", finished.stderr);
    }
}

#[tokio::test]
async fn a_second_signal_ends_it_at_once() {
    for (signal, expected) in [(Signal::Interrupt, 130), (Signal::Terminate, 143)] {
        let mut server = server!("--log", "info");
        // A stream that the client does not end keeps the server from stopping.
        let mut client = reflection(&server).await;
        let conversation = client.server_reflection_info(pending()).await.unwrap();
        server.process().signal(signal);
        server.log_until("stopping");
        let finished = server.stop(signal);
        assert_eq!(finished.status.code(), Some(expected));
        drop(conversation);
    }
}

/// A server without a grace period.
fn impatient() -> ServerProcess {
    let file = tempfile::NamedTempFile::new().unwrap();
    fs::write(file.path(), "[shutdown]\ngrace_ms = 1\n").unwrap();
    server!("--config", file.path().to_str().unwrap())
}

#[tokio::test]
async fn cut_calls_show_in_the_exit_status() {
    let server = impatient();
    let mut stubs = Stubs::connect(server.uri()).await;
    stubs.create("line", "R1").await;
    // The scan exceeds the buffers on its way.
    for _ in 0..8 {
        let request = v1::InsertRequest {
            index_name: "line".into(),
            states: Some(row_states(&[0.0; 32], 1)),
            payloads: vec![vec![0; 64 * 1024].into(); 32],
            ..Default::default()
        };
        stubs.insert(request).await;
    }
    let request = v1::ScanRequest {
        index_name: "line".into(),
        include: Some(v1::Include {
            with_payloads: true,
            ..Default::default()
        }),
        ..Default::default()
    };
    let mut parts = stubs.points.scan(request).await.unwrap().into_inner();
    parts.message().await.unwrap().unwrap();

    // The client reads no further, so the scan cannot end.
    let ProcessOutput { status, stderr, .. } = server.stop(Signal::Terminate);
    assert_eq!(status.code(), Some(1), "{stderr}");
    assert!(stderr.contains("shutdown.grace_ms"), "{stderr}");
    drop(parts);
}

#[tokio::test]
async fn a_conversation_that_is_no_call_is_cut_without_a_failure() {
    let server = impatient();
    let mut client = reflection(&server).await;
    let conversation = client.server_reflection_info(pending()).await.unwrap();
    let finished = server.stop(Signal::Terminate);
    assert_eq!(finished.status.code(), Some(0), "{}", finished.stderr);
    drop(conversation);
}

/// Asserts that a server does not start, and that its error contains all of these texts.
fn refused(arguments: &[&str], parts: &[&str]) {
    let finished = Process::start(env!("CARGO_BIN_EXE_server-process"), arguments).finish();
    assert_eq!(finished.status.code(), Some(1));
    assert_eq!(finished.stdout, Vec::<String>::new());
    for part in parts {
        assert!(finished.stderr.contains(part), "{}", finished.stderr);
    }
}

#[test]
fn an_address_it_cannot_have_is_named_with_what_to_do() {
    let taken = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = taken.local_addr().unwrap().to_string();
    let at = |address| ["--data", "memory", "--grpc", address];
    refused(&at(&address), &[&address, "--grpc 127.0.0.1:0"]);
    refused(&at("127.0.0.1"), &["HOST:PORT"]);
}

#[tokio::test]
async fn a_missing_file_of_marks_is_reported_once() {
    let directory = tempfile::tempdir().unwrap();
    let data = directory.path().to_str().unwrap();
    let marks = directory.path().join("marks");
    let start = || server!("--data", data);
    let warnings = |server: ServerProcess| {
        let finished = server.stop(Signal::Terminate);
        assert_eq!(finished.status.code(), Some(0), "{}", finished.stderr);
        finished
            .stderr
            .matches("file of the marks is missing or empty")
            .count()
    };
    // An empty store has no mark.
    assert_eq!(warnings(start()), 0);
    assert_eq!(warnings(start()), 0);
    let server = start();
    let mut stubs = Stubs::connect(server.uri()).await;
    stubs.create("line", "R1").await;
    assert_eq!(warnings(server), 0);
    for is_there in [true, false] {
        if is_there {
            fs::write(&marks, "").unwrap();
        } else {
            fs::remove_file(&marks).unwrap();
        }
        assert_eq!(warnings(start()), 1);
        assert_eq!(warnings(start()), 0);
    }
}

#[tokio::test]
async fn the_lines_of_a_call_name_the_trace_of_its_client() {
    let program = env!("CARGO_BIN_EXE_server-process");
    let debug = ["--data", "memory", "--log", "wayfold_server=debug"];
    let mut server = ServerProcess::start(program, &debug);
    let client = Client::connect(server.uri()).await.unwrap();
    let space: Space = "R1".parse().unwrap();
    let created = in_trace(TRACEPARENT, client.create_index("arm", &space)).await;
    created.unwrap().unwrap();
    client.index("arm").await.unwrap();
    let lines = server.log_until("GetIndex");
    let named: Vec<_> = lines.iter().filter(|it| it.contains(TRACE)).collect();
    assert!(!named.is_empty(), "{lines:#?}");
    assert!(
        named.iter().all(|it| it.contains("CreateIndex")),
        "{named:#?}"
    );
    for wrong in ["\n", "00-;token=another"] {
        assert!(in_trace(wrong, async {}).await.is_err());
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_calls_of_an_index_belong_to_the_trace_in_which_it_was_opened() {
    let mut server = server!(
        "--log",
        "wayfold_server=debug",
        "--zenoh",
        "tcp/127.0.0.1:0"
    );
    let session = measuring::connect(&server.zenoh()).await;
    let space: Space = "R1".parse().unwrap();
    let used = in_trace(TRACEPARENT, async {
        for open in [
            Index::shared(server.uri(), "shared"),
            Index::shared_over_zenoh(session.clone(), "wayfold/v1", "arm"),
        ] {
            let open = open.create(&space);
            let (index, copy) = (open.clone().open()?, open.open()?);
            let id = index.insert([0.5])?;
            index.flush()?;
            // The copy has it by its feed, and asks the server for the payload.
            while copy.len()? == 0 {
                thread::yield_now();
            }
            copy.payload(id)?;
        }
        let index = Index::remote(server.uri(), "remote");
        let index = index.create(&space).open()?;
        index.insert([0.5])?;
        assert_eq!(index.scan()?.count(), 1);
        Ok::<(), Error>(())
    });
    used.await.unwrap().unwrap();
    let log = server.stop(Signal::Terminate).stderr;
    let calls: Vec<_> = log.lines().filter(|it| it.contains("call ended")).collect();
    for rpc in [
        "IndexService/GetServer",
        "IndexService/CreateIndex",
        "PointService/Insert",
        "PointService/OpenSession",
        "PointService/Write",
        "PointService/Get",
        "PointService/Scan",
        "PointService/Watch",
        "Zenoh/server",
        "Zenoh/create",
        "Zenoh/session",
        "Zenoh/scan",
        "Zenoh/log",
        "Zenoh/write",
        "Zenoh/get",
    ] {
        assert!(calls.iter().any(|it| it.contains(rpc)), "{rpc}: {log}");
    }
    for call in calls {
        assert!(call.contains(TRACE), "{call}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_call_whose_client_left_is_no_warning_and_names_its_peer() {
    let mut server = server!("--log", "wayfold_server=debug");
    let mut stubs = Stubs::connect(server.uri()).await;
    let uid = stubs.create("line", "R1").await.revision.unwrap().uid;
    let mut points = stubs.points.clone();
    // It waits for a revision that never comes.
    let mut waiting = Box::pin(points.get(v1::GetRequest {
        index_name: "line".into(),
        ids: vec![1],
        min_revision: revision(&uid, 7),
        ..Default::default()
    }));
    assert!(poll!(waiting.as_mut()).is_pending());
    // These are behind it on the same connection.
    for _ in 0..3 {
        stubs.describe("line").await;
    }
    drop(waiting);
    let line = server.log_until("PointService/Get").pop().unwrap();
    for part in ["DEBUG", "call ended", "code=Cancelled", "peer=127.0.0.1:"] {
        assert!(line.contains(part), "{part}: {line}");
    }
}

#[tokio::test]
async fn a_slow_call_has_a_line_that_says_where_its_time_went() {
    let file = tempfile::NamedTempFile::new().unwrap();
    fs::write(
        file.path(),
        "[log]\nformat = \"json\"\nslow_call_ms = 100\n[grpc]\ndefault_timeout_ms = 1000\n",
    )
    .unwrap();
    let mut server = server!("--config", file.path().to_str().unwrap());
    let mut stubs = Stubs::connect(server.uri()).await;
    let uid = stubs.create("line", "R1").await.revision.unwrap().uid;
    // A revision that never comes: the call waits until its deadline.
    let mut waiting = Request::new(v1::GetRequest {
        index_name: "line".into(),
        ids: vec![1],
        min_revision: revision(&uid, 7),
        ..Default::default()
    });
    let metadata = waiting.metadata_mut();
    metadata.insert("traceparent", TRACEPARENT.parse().unwrap());
    let status = stubs.points.get(waiting).await.unwrap_err();
    assert_eq!(status.code(), Code::DeadlineExceeded, "{status:?}");
    // The call that created the index may be slow too.
    let line = server.log_until("PointService/Get").pop().unwrap();
    let line: serde_json::Value = serde_json::from_str(&line).unwrap();
    assert_eq!(line["span"]["rpc"], "PointService/Get", "{line}");
    assert_eq!(line["span"]["index"], "line", "{line}");
    assert_eq!(line["span"]["trace"], TRACE, "{line}");
    assert_eq!(line["span"]["parent"], "00f067aa0ba902b7", "{line}");
    assert!(line["span"]["peer"].is_string(), "{line}");
    let ms = |field: &str| line["fields"][field].as_u64().unwrap();
    let (total, waited) = (ms("total_ms"), ms("waiting_ms"));
    assert!(total >= 1_000, "{line}");
    let others = ["receiving_ms", "queued_ms", "computing_ms", "sending_ms"];
    let others: u64 = others.map(ms).iter().sum();
    // Each part is cut to milliseconds.
    assert!((total - 5..=total).contains(&(waited + others)), "{line}");
    assert!(waited > others, "{line}");
}

#[tokio::test]
async fn the_line_of_a_call_has_the_index_no_longer_than_a_name_may_be() {
    let server = server!("--log", "wayfold_server=debug");
    let mut stubs = Stubs::connect(server.uri()).await;
    let request = v1::GetRequest {
        // The cut would split a character.
        index_name: format!("a{}", "ü".repeat(500_000)),
        ids: vec![1],
        ..Default::default()
    };
    stubs.points.get(request).await.unwrap_err();
    let log = server.stop(Signal::Terminate).stderr;
    let line = log.lines().find(|line| line.contains("PointService/Get"));
    let line = line.unwrap();
    assert!(line.contains("index=\"aüü"), "{}", line.len());
    assert!(line.len() < 1_000, "{}", line.len());
}

#[test]
fn a_data_directory_that_it_cannot_have_is_named_with_what_to_do() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().to_str().unwrap();
    let server = server!("--data", path);
    let again = ["--data", path, "--grpc", "127.0.0.1:0"];
    refused(&again, &[path, "in use by another wayfold-server"]);
    let finished = server.stop(Signal::Terminate);
    assert_eq!(finished.status.code(), Some(0), "{}", finished.stderr);
    let stdout = finished.stdout.join("\n");
    assert!(stdout.contains(&format!("kept in {path}")), "{stdout}");

    fs::write(directory.path().join("wayfold-data"), "another form").unwrap();
    refused(&again, &["missing or damaged"]);
    fs::remove_dir_all(directory.path().join("store")).unwrap();
    refused(&again, &["not a data directory"]);
}
