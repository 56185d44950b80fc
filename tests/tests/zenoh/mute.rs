//! Peers that read none of their answers block no other peer and are disconnected.

use serde_json::{Value, json};
use tokio::{
    io::{AsyncReadExt, AsyncWriteExt, copy},
    net::{TcpListener, TcpSocket},
    sync::oneshot,
    task::{self, JoinHandle},
    time::timeout,
};
use wayfold_tests::{ServerProcess, Signal};
use zenoh::{Session, Wait};

use crate::robot::{MAX_WAIT, Robot, reason, server_with, session};

/// The number of muted peers, more than Zenoh has threads that read links.
const PEERS: usize = 3;
/// The number of queries whose answers, and even whose refusals, exceed the small buffers of a link.
const QUERIES: usize = 200;
const REFUSED: usize = 4_000;
const SMALL_BUFFER: u32 = 4096;

/// A peer and the relay between it and the server.
struct MutedPeer {
    session: Session,
    stop_listening: oneshot::Sender<()>,
    /// Ends once the server has disconnected it.
    relay: JoinHandle<()>,
}

impl MutedPeer {
    async fn connect(server: &str) -> Self {
        let server = server.strip_prefix("tcp/").unwrap().parse().unwrap();
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let at = format!("tcp/{}", listener.local_addr().unwrap());
        let (stop_listening, mut stopped) = oneshot::channel();
        let relay = tokio::spawn(async move {
            let (mut peer, _) = listener.accept().await.unwrap();
            drop(listener);
            let socket = TcpSocket::new_v4().unwrap();
            socket.set_recv_buffer_size(SMALL_BUFFER).unwrap();
            let mut server = socket.connect(server).await.unwrap();
            let ((mut from_peer, mut to_peer), (mut from_server, mut to_server)) =
                (peer.split(), server.split());
            let requests = copy(&mut from_peer, &mut to_server);
            let answered = async {
                let mut buffer = [0; SMALL_BUFFER as usize];
                loop {
                    tokio::select! {
                        biased;
                        _ = &mut stopped => break std::future::pending::<()>().await,
                        read = from_server.read(&mut buffer) => {
                            to_peer.write_all(&buffer[..read.unwrap()]).await.unwrap();
                        }
                    }
                }
            };
            tokio::select! {
                // If the other side no longer reads, the peer's next write fails, at the latest its next keep-alive.
                _ = requests => {}
                () = answered => {}
            }
        });
        Self {
            session: session("client", &[], &[&at]).await,
            stop_listening,
            relay,
        }
    }

    /// Reads no answer from now on, sends queries, and finally inserts a point. Returns the relay.
    fn ask(self, queries: usize) -> JoinHandle<()> {
        self.stop_listening.send(()).unwrap();
        // The call blocks while the link is full.
        task::spawn_blocking(move || {
            let send = |selector: &str, payload: &str| {
                let query = self.session.get(format!("wayfold/v1/{selector}"));
                // A disconnected session has no peer to query.
                let _ = query.payload(payload).timeout(MAX_WAIT).wait();
            };
            for _ in 0..queries {
                send("arm/knn?k=100", "[0.05]");
            }
            send("done/insert", "[[1]]");
            // The session stays open until its process ends, because it sends no close message.
            std::mem::forget(self.session);
        });
        self.relay
    }
}

/// Starts muted peers, and returns another peer and the relays of the muted ones.
async fn beside_mutes(locator: &str, queries: usize) -> (Robot, Vec<JoinHandle<()>>) {
    let robot = Robot::connect(locator).await;
    for name in ["arm", "done"] {
        let create = json!({ "name": name, "space_text": "R1" });
        robot.json("create", create).await.unwrap();
    }
    let rows: Vec<[f64; 1]> = (0..1000).map(|row| [f64::from(row) / 7.0]).collect();
    robot.json("arm/insert", json!(rows)).await.unwrap();
    let mut mutes = Vec::new();
    for _ in 0..PEERS {
        mutes.push(MutedPeer::connect(locator).await);
    }
    (
        robot,
        mutes.into_iter().map(|mute| mute.ask(queries)).collect(),
    )
}

/// A server with small buffers, which waits `wait_us` for a peer to read an answer and works on at most `max_calls`
/// calls at a time. No peer's lease ends before that.
fn server(wait_us: u64, max_calls: &str) -> (ServerProcess, String) {
    let tx = json!({
        // The lease of an hour has 36,000 keep-alives, one each 100 ms. Zenoh tries for one such interval to send the
        // rest.
        "lease": 3_600_000,
        "keep_alive": 36_000,
        "queue": { "congestion_control": { "block": { "wait_before_close": wait_us } } },
    });
    let link = json!({ "tcp": { "so_sndbuf": SMALL_BUFFER }, "tx": tx });
    let config = json!({ "transport": { "link": link } }).to_string();
    let settings = [
        ("WAYFOLD_ZENOH__CONFIG", &*config),
        ("WAYFOLD_ZENOH__MAX_CALLS", max_calls),
        // A refused insert would tell nothing of the queries before it.
        ("WAYFOLD_ADMISSION__BURST_MS", "60000"),
        ("WAYFOLD_SHUTDOWN__GRACE_MS", "1"),
    ];
    server_with(&[], &settings)
}

/// A server with answers that wait this long for their peers, and another peer.
async fn beside_waiting_answers(wait_us: u64) -> (ServerProcess, Robot) {
    let (server, locator) = server(wait_us, "1024");
    let (robot, _relays) = beside_mutes(&locator, QUERIES).await;
    // The queries of a peer are read in order; the server does not read the last ones of a peer for which a thread
    // waits.
    let inserted = async {
        let mut done = 0;
        while done < PEERS - 1 {
            let described = robot.json("done/info", Value::Null).await.unwrap();
            done = described["index"]["point_count"].as_u64().unwrap() as usize;
        }
    };
    timeout(MAX_WAIT, inserted).await.unwrap();
    (server, robot)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn peers_that_read_no_answers_delay_nobody() {
    // The wait lasts longer than this test.
    let (_server, robot) = beside_waiting_answers(3_600_000_000).await;
    for _ in 0..QUERIES {
        let near = robot.json("arm/knn?k=1", json!([0.0])).await.unwrap();
        assert_eq!(near["ids"], json!([[0]]));
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn calls_beyond_the_grace_period_are_cut_and_show_in_the_exit_status() {
    // The wait lasts longer than this test.
    let (mut server, _robot) = beside_waiting_answers(3_600_000_000).await;
    server.process().signal(Signal::Terminate);
    server.log_until("cutting unfinished calls");
    let ended = task::spawn_blocking(|| server.finish()).await.unwrap();
    assert_eq!(ended.status.code(), Some(1), "{}", ended.stderr);
    assert!(ended.stderr.contains("calls were cut"), "{}", ended.stderr);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn peers_that_read_no_answers_are_disconnected() {
    let (_server, locator) = server(100_000, "1024");
    let (robot, relays) = beside_mutes(&locator, QUERIES).await;
    for relay in relays {
        relay.await.unwrap();
    }
    robot.json("arm/info", Value::Null).await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn peers_that_read_no_refusals_are_disconnected() {
    // Most of the queries exceed the capacity.
    let (_server, locator) = server(100_000, "4");
    let (robot, relays) = beside_mutes(&locator, REFUSED).await;
    for relay in relays {
        while !relay.is_finished() {
            match robot.json("arm/knn?k=1", json!([0.0])).await {
                Ok(near) => assert_eq!(near["ids"], json!([[0]])),
                Err(refusal) => assert_eq!(reason(&refusal).1, "TOO_MANY_CALLS"),
            }
        }
        relay.await.unwrap();
    }
    while let Err(refusal) = robot.json("arm/info", Value::Null).await {
        assert_eq!(reason(&refusal).1, "TOO_MANY_CALLS");
    }
}

/// Their links are not read meanwhile, and those of others are: Zenoh has fewer threads for links than there are peers.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn peers_that_read_no_refusals_delay_nobody() {
    // The wait lasts longer than this test.
    let (_server, locator) = server(3_600_000_000, "4");
    let (robot, _relays) = beside_mutes(&locator, REFUSED).await;
    for _ in 0..REFUSED {
        if let Err(refusal) = robot.json("arm/info", Value::Null).await {
            assert_eq!(reason(&refusal).1, "TOO_MANY_CALLS");
        }
    }
}
