//! Clients that begin streamed answers and read next to nothing of them, or requests that they do not end.

use std::{io::Read, net::TcpStream, path::Path, thread, time::Duration};

use prost::Message;
use tokio::time::{interval, timeout};
use tonic::{Code, Request};
use wayfold_proto::v1::{
    GetIndexRequest, Include, InsertRequest, Revision, ScanRequest, SnapshotIndexRequest,
    WatchRequest,
};
use wayfold_tests::{
    ServerProcess, Signal, States, Stubs, figures::anonymous_bytes, insert_request, server,
};

use crate::{
    backlog::{END_STREAM, begin, begin_half, connection},
    metrics::figures,
};

const MIB: usize = 1024 * 1024;
const CONNECTIONS: usize = 4;
/// A test fails after this many looks at the bytes that are held.
const MAX_LOOKS: usize = 10_000;
/// The most streams of a connection that last.
const STREAMS: u32 = 24;
/// The budget of all bytes. A connection has a quarter of it.
const MAX_BYTES: usize = 16 * MIB;
/// The part of it that connections with one large message each may take.
const LARGEST_OF_ALL: usize = MAX_BYTES / 8 * 7;
/// The mutations of the index: more than the server keeps in memory.
const MUTATIONS: usize = 12;
/// The longest wait of the other client. It is shorter than the time after which the server cuts a connection that takes nothing.
const MAX_WAIT: Duration = Duration::from_secs(45);
const PAYLOAD_BYTES: usize = 4096;
const ROWS: usize = 200;

struct Attack {
    server: ServerProcess,
    pages: String,
    stubs: Stubs,
    /// The first revision of the index.
    origin: Revision,
}

impl Attack {
    async fn prepare(data: &Path) -> Self {
        let mut server = server!(
            "--http", "127.0.0.1:0", "--data", data.to_str().unwrap();
            ("WAYFOLD_GRPC__MAX_MESSAGE_BYTES", &MIB.to_string()),
            ("WAYFOLD_ZENOH__MAX_MESSAGE_BYTES", &MIB.to_string()),
            ("WAYFOLD_ADMISSION__MAX_BYTES", &MAX_BYTES.to_string())
        );
        let pages = server.pages();
        let mut stubs = Stubs::connect(server.uri()).await;
        stubs.create("arm", "R3").await;
        let mut states = States::new("R3".parse().unwrap(), 19);
        for _ in 0..MUTATIONS {
            stubs.insert(inserted(&mut states)).await;
        }
        let index = GetIndexRequest {
            index_name: "arm".into(),
        };
        let index = stubs.indexes.get_index(index).await.unwrap().into_inner();
        let revision = index.index.unwrap().revision.unwrap();
        Self {
            server,
            pages,
            stubs,
            origin: Revision {
                number: 0,
                ..revision
            },
        }
    }

    /// Begins calls over many connections, and looks at the server's memory for a while. Returns the connections.
    fn begin(&self, path: &str, request: &impl Message, window: u8) -> Vec<TcpStream> {
        const LOOKS: usize = 1000;
        let used = || anonymous_bytes(self.server.process().id()).unwrap() as usize;
        let before = used();
        let request = request.encode_to_vec();
        let begun = (0..CONNECTIONS).map(|_| {
            let mut socket = connection(self.server.uri(), window);
            for stream in 0..STREAMS {
                begin(&mut socket, 2 * stream + 1, path, &request, END_STREAM).unwrap();
            }
            socket
        });
        let begun = begun.collect();
        for _ in 0..LOOKS {
            let held = self.held();
            // Each connection may make one more part.
            assert!(held < MAX_BYTES + CONNECTIONS * 2 * MIB, "{held} bytes");
            let grown = used().saturating_sub(before);
            assert!(grown < 2 * MAX_BYTES, "{grown} bytes");
        }
        begun
    }

    /// The bytes that calls hold.
    fn held(&self) -> usize {
        figures(&self.pages)["wayfold_in_flight_bytes{of=\"held\"}"] as usize
    }

    fn wait_until_held(&self, bytes: usize) {
        let mut looks = 0..MAX_LOOKS;
        while self.held() < bytes {
            assert!(looks.next().is_some(), "{} of {bytes}", self.held());
        }
    }

    fn watch(&self) -> WatchRequest {
        WatchRequest {
            index_name: "arm".into(),
            after_revision: Some(self.origin.clone()),
            include: Some(include()),
            ..Default::default()
        }
    }
}

/// A mutation.
fn inserted(states: &mut States) -> InsertRequest {
    InsertRequest {
        payloads: vec![vec![7; PAYLOAD_BYTES].into(); ROWS],
        ..insert_request("arm", &states.rows(ROWS), 3)
    }
}

fn include() -> Include {
    Include {
        with_states: true,
        with_payloads: true,
        ..Default::default()
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn unread_watches_hold_no_more_than_their_share_and_others_go_on() {
    let directory = tempfile::tempdir().unwrap();
    let mut attack = Attack::prepare(directory.path()).await;
    let watch = attack.watch();
    // With nothing to send to, the server asks a stream for no message after the first.
    let _unread =
        [0, 100].map(|window| attack.begin("/wayfold.v1.PointService/Watch", &watch, window));
    let mut watch = Request::new(watch);
    watch.set_timeout(MAX_WAIT);
    let watched = attack.stubs.points.watch(watch).await;
    let mut watched = watched.unwrap().into_inner();
    let mut ended = 0;
    while ended < MUTATIONS {
        let message = watched.message().await.unwrap().unwrap();
        let whole = message.mutations.iter().filter(|piece| !piece.continued);
        ended += whole.count();
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn unread_scans_hold_no_more_than_their_share_and_others_go_on() {
    let directory = tempfile::tempdir().unwrap();
    let mut attack = Attack::prepare(directory.path()).await;
    let scan = ScanRequest {
        index_name: "arm".into(),
        include: Some(include()),
        ..Default::default()
    };
    let _unread = attack.begin("/wayfold.v1.PointService/Scan", &scan, 100);
    let mut scanned = attack.stubs.points.scan(scan).await.unwrap().into_inner();
    let mut points = 0;
    while let Some(part) = scanned.message().await.unwrap() {
        points += part.points.unwrap().ids.len();
    }
    assert_eq!(points, MUTATIONS * ROWS);
}

/// Reads a small answer now and then, as long as the server lets it.
fn read_a_little(mut socket: TcpStream, request: &[u8]) {
    const PAUSE: Duration = Duration::from_millis(200);
    let mut numbers = (2 * STREAMS + 1..).step_by(2);
    let mut read = [0; 4096];
    socket.set_read_timeout(Some(PAUSE)).unwrap();
    loop {
        let (path, number) = ("/wayfold.v1.IndexService/GetIndex", numbers.next().unwrap());
        if begin(&mut socket, number, path, request, END_STREAM).is_err() {
            return;
        }
        // It waits for what the answer before it lacks, and for the pause.
        while socket.read(&mut read).is_ok_and(|bytes| bytes > 0) {}
    }
}

/// Inserts until the server has room for it, while these clients read a little.
async fn insert_beside(mut attack: Attack, begun: Vec<TcpStream>) {
    let request = GetIndexRequest {
        index_name: "arm".into(),
    };
    let clients = begun.into_iter().map(|socket| {
        let request = request.encode_to_vec();
        thread::spawn(move || read_a_little(socket, &request))
    });
    let clients: Vec<_> = clients.collect();
    let request = inserted(&mut States::new("R3".parse().unwrap(), 20));
    let inserted = timeout(MAX_WAIT, async {
        let mut pauses = interval(Duration::from_millis(100));
        let mut refused = 0;
        loop {
            pauses.tick().await;
            match attack.stubs.points.insert(request.clone()).await {
                Ok(_) => break refused,
                Err(status) => assert_eq!(status.code(), Code::ResourceExhausted, "{status}"),
            }
            refused += 1;
        }
    });
    assert!(inserted.await.expect("no bytes are left for an insert") > 0);
    attack.server.process().signal(Signal::Kill);
    for client in clients {
        client.join().unwrap();
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn clients_that_leave_answers_unread_do_not_keep_the_bytes_of_all() {
    let directory = tempfile::tempdir().unwrap();
    let attack = Attack::prepare(directory.path()).await;
    let scan = ScanRequest {
        index_name: "arm".into(),
        include: Some(include()),
        ..Default::default()
    };
    let scan = scan.encode_to_vec();
    let sockets = (0..MAX_BYTES / MIB).map(|_| {
        let mut socket = connection(attack.server.uri(), 255);
        let path = "/wayfold.v1.PointService/Scan";
        begin(&mut socket, 1, path, &scan, END_STREAM).unwrap();
        socket
    });
    let sockets = sockets.collect();
    attack.wait_until_held(LARGEST_OF_ALL);
    insert_beside(attack, sockets).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn clients_that_send_half_of_their_requests_do_not_keep_the_bytes_of_all() {
    // With the insert they would hold more than large messages may.
    const HALVES: usize = 2 * LARGEST_OF_ALL / MIB - 1;
    let directory = tempfile::tempdir().unwrap();
    let attack = Attack::prepare(directory.path()).await;
    let mut sockets = Vec::new();
    for half in 1..=HALVES {
        let mut socket = connection(attack.server.uri(), 255);
        let path = "/wayfold.v1.PointService/Insert";
        begin_half(&mut socket, 1, path, MIB).unwrap();
        sockets.push(socket);
        // The next one comes only after that.
        attack.wait_until_held(half * MIB / 2);
    }
    insert_beside(attack, sockets).await;
}

/// The client takes no byte, so the server makes only the short first part of each snapshot. It has read the next part
/// from the store by then.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_parts_of_unread_snapshots_count_before_they_are_made() {
    const SNAPSHOTS: u32 = 10;
    const PART_BYTES: f64 = 256.0 * 1024.0;
    let mut server = server!("--http", "127.0.0.1:0");
    let pages = server.pages();
    let mut stubs = Stubs::connect(server.uri()).await;
    stubs.create("arm", "R3").await;
    let rows = States::new("R3".parse().unwrap(), 19).rows(20_000);
    stubs.insert(insert_request("arm", &rows, 3)).await;
    let request = SnapshotIndexRequest {
        index_name: "arm".into(),
        ..Default::default()
    };
    let mut socket = connection(server.uri(), 0);
    for number in 0..SNAPSHOTS {
        let path = "/wayfold.v1.IndexService/SnapshotIndex";
        begin(
            &mut socket,
            2 * number + 1,
            path,
            &request.encode_to_vec(),
            END_STREAM,
        )
        .unwrap();
    }
    let held = || figures(&pages)["wayfold_in_flight_bytes{of=\"held\"}"];
    let mut looks = 0..MAX_LOOKS;
    while held() < f64::from(SNAPSHOTS) * PART_BYTES {
        assert!(looks.next().is_some(), "{}", held());
    }
}
