//! Peers that ask and take none of their answers: they hold up nobody, and are cut off.

use serde_json::json;
use tokio::{
    io::{AsyncReadExt, AsyncWriteExt, copy},
    net::{TcpListener, TcpSocket},
    sync::oneshot,
    task::{self, JoinHandle},
};
use zenoh::{Session, Wait};

use crate::robot::{PATIENCE, Robot, server_with, session};

/// More than Zenoh has threads that read links.
const PEERS: usize = 3;
/// Their answers are more than a link with small buffers takes.
const QUERIES: usize = 200;
const SMALL_BUFFER: u32 = 4096;

/// A peer, and what is between it and the server.
struct Mute {
    session: Session,
    stop_listening: oneshot::Sender<()>,
    /// Ends once the server has cut it off.
    relay: JoinHandle<()>,
}

impl Mute {
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
            let asked = copy(&mut from_peer, &mut to_server);
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
                // Where nobody reads any more, what the peer sends comes back as an error: at the latest its next sign
                // of life.
                _ = asked => {}
                () = answered => {}
            }
        });
        Self {
            session: session("client", &[], &[&at]).await,
            stop_listening,
            relay,
        }
    }

    /// Takes no answer from now on, and asks. What asks and the relay are given back.
    fn ask(self) -> (JoinHandle<()>, JoinHandle<()>) {
        self.stop_listening.send(()).unwrap();
        // It blocks while the link is full.
        let asking = task::spawn_blocking(move || {
            for _ in 0..QUERIES {
                let query = self.session.get("wayfold/v1/arm/knn?k=100");
                let _ = query.payload("[0.05]").timeout(PATIENCE).wait();
            }
            // Open until its process ends: it does not say goodbye.
            std::mem::forget(self.session);
        });
        (asking, self.relay)
    }
}

/// Has peers ask and not listen, and another ask and listen meanwhile; the relays of the former.
async fn ask_beside_mutes(locator: &str) -> Vec<JoinHandle<()>> {
    let robot = Robot::connect(locator).await;
    let create = json!({ "name": "arm", "space_text": "R1" });
    robot.json("create", create).await.unwrap();
    let rows: Vec<[f64; 1]> = (0..1000).map(|row| [f64::from(row) / 7.0]).collect();
    robot
        .json("arm/insert", json!({ "states": rows }))
        .await
        .unwrap();
    let mut mutes = Vec::new();
    for _ in 0..PEERS {
        mutes.push(Mute::connect(locator).await);
    }
    let (asking, relays): (Vec<_>, Vec<_>) = mutes.into_iter().map(Mute::ask).unzip();
    for asking in asking {
        asking.await.unwrap();
    }
    for _ in 0..QUERIES {
        let near = robot.json("arm/knn?k=1", json!([0.0])).await.unwrap();
        assert_eq!(near["ids"], json!([[0]]));
    }
    relays
}

/// A server with small buffers, that waits so long for a peer to take an answer.
fn server(wait_us: u64) -> (wayfold_tests::ServerProcess, String) {
    let link = json!({
        "tcp": { "so_sndbuf": SMALL_BUFFER },
        "tx": { "queue": { "congestion_control": { "block": { "wait_before_close": wait_us } } } },
    });
    let config = json!({ "transport": { "link": link } }).to_string();
    server_with(&[], &[("WAYFOLD_ZENOH__CONFIG", &config)])
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn those_who_take_no_answers_hold_up_nobody() {
    // As long as this test lasts.
    let (_server, locator) = server(3_600_000_000);
    ask_beside_mutes(&locator).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn those_who_take_no_answers_are_cut_off() {
    let (_server, locator) = server(100_000);
    for relay in ask_beside_mutes(&locator).await {
        relay.await.unwrap();
    }
    let robot = Robot::connect(&locator).await;
    robot.json("arm/info", json!({})).await.unwrap();
}
