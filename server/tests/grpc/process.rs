//! The binary: its first line, what signals do to it, and how it exits.
#![cfg(unix)]

use std::{
    io::{BufRead, BufReader, Read},
    net::{SocketAddr, TcpListener},
    process::{Child, ChildStdout, Command, Stdio},
};

use crate::harness::{connect, insert};
use tokio_stream::pending;
use tonic_reflection::pb::v1::server_reflection_client::ServerReflectionClient;
use wayfold_proto::v1::{
    self, index_service_client::IndexServiceClient, point_service_client::PointServiceClient,
};

/// A server in a process of its own, which ends with the test.
struct Server {
    child: Child,
    stdout: BufReader<ChildStdout>,
    address: SocketAddr,
}

impl Server {
    fn start(arguments: &[&str]) -> Self {
        let mut child = Command::new(env!("CARGO_BIN_EXE_wayfold-server"))
            .args(arguments)
            .env("WAYFOLD_GRPC__LISTEN", "127.0.0.1:0")
            .env("WAYFOLD_DATA__DIR", "memory")
            .env("WAYFOLD_ZENOH__LISTEN", "off")
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let mut stdout = BufReader::new(child.stdout.take().unwrap());
        let mut first = String::new();
        stdout.read_line(&mut first).unwrap();
        let address = first.trim_end().strip_prefix("listening on http://");
        let address = address.unwrap_or_else(|| panic!("{first:?}")).parse();
        Self {
            child,
            stdout,
            address: address.unwrap(),
        }
    }

    fn signal(&self, name: &str) {
        // The shell's own kill, which every Unix has.
        let kill = format!("kill -{name} {}", self.child.id());
        let status = Command::new("sh").args(["-c", &kill]).status().unwrap();
        assert!(status.success());
    }

    /// The exit status and what was written to standard output and standard error meanwhile.
    fn finish(mut self) -> (Option<i32>, String, String) {
        let (mut stdout, mut stderr) = (String::new(), String::new());
        self.stdout.read_to_string(&mut stdout).unwrap();
        let mut pipe = self.child.stderr.take().unwrap();
        pipe.read_to_string(&mut stderr).unwrap();
        (self.child.wait().unwrap().code(), stdout, stderr)
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        // It has ended already unless the test failed.
        let _ = self.child.kill();
    }
}

#[test]
fn it_says_what_to_type_next_and_stops_on_either_signal() {
    for name in ["TERM", "INT"] {
        let server = Server::start(&[]);
        let hint = format!("--server http://{} create", server.address);
        server.signal(name);
        let (status, stdout, stderr) = server.finish();
        assert_eq!(status, Some(0), "{stderr}");
        assert!(stdout.contains(&hint), "{stdout}");
        assert!(stderr.contains("stopped"), "{stderr}");
    }
}

#[tokio::test]
async fn a_second_signal_ends_it_at_once() {
    for (name, expected) in [("INT", 130), ("TERM", 143)] {
        let mut server = Server::start(&["--log", "info"]);
        // A conversation that this side does not end keeps the server from stopping.
        let mut client = ServerReflectionClient::new(connect(server.address).await);
        let conversation = client.server_reflection_info(pending()).await.unwrap();
        server.signal(name);
        let mut stderr = BufReader::new(server.child.stderr.take().unwrap());
        let mut line = String::new();
        while !line.contains("stopping") {
            line.clear();
            assert_ne!(stderr.read_line(&mut line).unwrap(), 0);
        }
        server.signal(name);
        assert_eq!(server.child.wait().unwrap().code(), Some(expected));
        drop(conversation);
    }
}

#[tokio::test]
async fn what_is_cut_shows_in_the_exit_status() {
    let file = tempfile::NamedTempFile::new().unwrap();
    std::fs::write(file.path(), "[shutdown]\ngrace_ms = 1\n").unwrap();
    let server = Server::start(&["--config", file.path().to_str().unwrap()]);
    let channel = connect(server.address).await;
    let line = v1::CreateIndexRequest {
        name: "line".into(),
        space_form: Some(v1::create_index_request::SpaceForm::SpaceText("R1".into())),
    };
    let mut indices = IndexServiceClient::new(channel.clone());
    indices.create_index(line).await.unwrap();
    let mut points = PointServiceClient::new(channel);
    // More than fits into the buffers on its way.
    for _ in 0..8 {
        let request = v1::InsertRequest {
            payloads: vec![vec![0; 64 * 1024].into(); 32],
            ..insert("line", &[0.0; 32])
        };
        points.insert(request).await.unwrap();
    }
    let request = v1::ScanRequest {
        index: "line".into(),
        include: Some(v1::Include {
            payloads: true,
            ..Default::default()
        }),
        ..Default::default()
    };
    let mut parts = points.scan(request).await.unwrap().into_inner();
    parts.message().await.unwrap().unwrap();

    // The client reads no further, so the scan cannot end.
    server.signal("TERM");
    let (status, _, stderr) = server.finish();
    assert_eq!(status, Some(1), "{stderr}");
    assert!(stderr.contains("shutdown.grace_ms"), "{stderr}");
    drop(parts);
}

#[tokio::test]
async fn a_conversation_that_is_no_call_is_cut_without_a_failure() {
    let file = tempfile::NamedTempFile::new().unwrap();
    std::fs::write(file.path(), "[shutdown]\ngrace_ms = 1\n").unwrap();
    let server = Server::start(&["--config", file.path().to_str().unwrap()]);
    let mut client = ServerReflectionClient::new(connect(server.address).await);
    let conversation = client.server_reflection_info(pending()).await.unwrap();
    server.signal("TERM");
    let (status, _, stderr) = server.finish();
    assert_eq!(status, Some(0), "{stderr}");
    drop(conversation);
}

fn refused(arguments: &[&str]) -> (Option<i32>, String) {
    let output = Command::new(env!("CARGO_BIN_EXE_wayfold-server"))
        .args(arguments)
        .env("WAYFOLD_DATA__DIR", "memory")
        .env("WAYFOLD_ZENOH__LISTEN", "off")
        .output()
        .unwrap();
    assert!(output.stdout.is_empty());
    (
        output.status.code(),
        String::from_utf8(output.stderr).unwrap(),
    )
}

#[test]
fn an_address_it_cannot_have_is_named_with_what_to_do() {
    let taken = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = taken.local_addr().unwrap().to_string();
    let (status, stderr) = refused(&["--grpc", &address]);
    assert_eq!(status, Some(1));
    assert!(
        stderr.contains(&address) && stderr.contains("--grpc 127.0.0.1:0"),
        "{stderr}"
    );

    let (status, stderr) = refused(&["--grpc", "127.0.0.1"]);
    assert_eq!(status, Some(1));
    assert!(stderr.contains("HOST:PORT"), "{stderr}");
}

#[tokio::test]
async fn a_file_of_marks_that_is_gone_is_told_of_once() {
    let directory = tempfile::tempdir().unwrap();
    let data = ["--data", directory.path().to_str().unwrap()];
    let marks = directory.path().join("marks");
    let told = |server: Server| {
        server.signal("TERM");
        let (status, _, stderr) = server.finish();
        assert_eq!(status, Some(0), "{stderr}");
        stderr.matches("no mark says").count()
    };
    // An empty store has no mark.
    assert_eq!(told(Server::start(&data)), 0);
    assert_eq!(told(Server::start(&data)), 0);
    let server = Server::start(&data);
    let line = v1::CreateIndexRequest {
        name: "line".into(),
        space_form: Some(v1::create_index_request::SpaceForm::SpaceText("R1".into())),
    };
    let mut indices = IndexServiceClient::new(connect(server.address).await);
    indices.create_index(line).await.unwrap();
    assert_eq!(told(server), 0);
    for is_there in [true, false] {
        if is_there {
            std::fs::write(&marks, "").unwrap();
        } else {
            std::fs::remove_file(&marks).unwrap();
        }
        assert_eq!(told(Server::start(&data)), 1);
        assert_eq!(told(Server::start(&data)), 0);
    }
}

#[test]
fn a_data_directory_that_it_cannot_have_is_named_with_what_to_do() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().to_str().unwrap();
    let data = ["--data", path];
    let server = Server::start(&data);
    let again = [&data[..], &["--grpc", "127.0.0.1:0"]].concat();
    let (status, stderr) = refused(&again);
    assert_eq!(status, Some(1));
    assert!(
        stderr.contains(path) && stderr.contains("in use by another wayfold-server"),
        "{stderr}"
    );
    server.signal("TERM");
    let (status, stdout, stderr) = server.finish();
    assert_eq!(status, Some(0), "{stderr}");
    assert!(stdout.contains(&format!("kept in {path}")), "{stdout}");

    std::fs::write(directory.path().join("wayfold-data"), "another form").unwrap();
    let (status, stderr) = refused(&again);
    assert_eq!(status, Some(1));
    assert!(stderr.contains("missing or damaged"), "{stderr}");
    std::fs::remove_dir_all(directory.path().join("store")).unwrap();
    let (status, stderr) = refused(&again);
    assert_eq!(status, Some(1));
    assert!(stderr.contains("not a data directory"), "{stderr}");
}
