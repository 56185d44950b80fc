//! The servers of a cluster forget the records of the journal that all of them store, and one that comes back without its
//! directory takes a copy. The environment variable `NATS_SERVER` has the path of the program nats-server.

use std::{
    io::{Read, Write},
    net::TcpStream,
};

use tokio::time::timeout;
use wayfold_tests::{ServerProcess, Signal, Stubs};

use crate::{
    healing::{HEALED, latest_content, together},
    journal_loss::{Cluster, MAX_WAIT, insert},
    metrics::figures,
};

/// Records are old after a second, and the journal is trimmed each second.
const SETTINGS: [(&str, &str); 3] = [
    ("WAYFOLD_INDEX__WINDOW_BYTES", "1"),
    ("WAYFOLD_INDEX__WINDOW_SECONDS", "1"),
    (
        "WAYFOLD_LOG__FILTER",
        "info,wayfold_server::service::trim=debug",
    ),
];

const ROUNDS: u64 = 3;
const POINTS_A_ROUND: u64 = 100;
/// The newest message, and what a round of the members had not trimmed yet.
const MOST_MESSAGES: usize = 10;

const ALONE: &str = "no other server is live, so the journal is not trimmed";
const HELD: &str = "a server holds back the trimming of the journal";

fn start(cluster: &Cluster, number: usize) -> ServerProcess {
    cluster.start_with(number, &SETTINGS)
}

#[ignore = "needs nats-server"]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_journal_keeps_what_the_servers_do_not_store() {
    let cluster = Cluster::empty();
    let [first, second] = together(&cluster, &SETTINGS);
    let mut stubs = Stubs::connect(first.uri()).await;
    let created = stubs.create("arm", "R1").await;
    let uid = created.revision.unwrap().uid;
    let mut points = 0;
    for _ in 0..ROUNDS {
        for _ in 0..POINTS_A_ROUND {
            insert(&mut stubs, points).await.unwrap();
            points += 1;
        }
        let trimmed = async {
            while cluster.nats.messages(&uid).await.1.len() > MOST_MESSAGES {
                tokio::task::yield_now().await;
            }
        };
        timeout(MAX_WAIT, trimmed).await.unwrap();
    }
    let expected = latest_content(&mut stubs).await.points;
    assert_eq!(expected.len() as u64, points);

    // A server that has lost its directory has them from the other.
    second.stop(Signal::Kill);
    cluster.lose(1);
    let mut second = start(&cluster, 1);
    second.log_until(HEALED);
    let mut others = Stubs::connect(second.uri()).await;
    assert_eq!(latest_content(&mut others).await.points, expected);
    insert(&mut others, points).await.unwrap();
    points += 1;

    // Alone it trims nothing. Two rounds: one may have begun with the other server.
    first.stop(Signal::Kill);
    let mut log = second.log_until("a server of the cluster is not heard");
    for _ in 0..2 {
        log.extend(second.log_until(ALONE));
    }
    let oldest = cluster.nats.messages(&uid).await.1[0].sequence;
    for _ in 0..POINTS_A_ROUND {
        insert(&mut others, points).await.unwrap();
        points += 1;
    }
    for _ in 0..2 {
        log.extend(second.log_until(ALONE));
    }
    // The log tells of it once, and the metric as long as it lasts.
    if !log.iter().any(|line| line.contains(HELD)) {
        second.log_until(HELD);
    }
    let pages = second.pages();
    let held = "wayfold_index_held_records{index=\"arm\"}";
    let counted = figures(&pages)[held];
    assert!(counted > 0.0, "{counted}");
    let (_, messages) = cluster.nats.messages(&uid).await;
    assert_eq!(messages[0].sequence, oldest);
    assert!(messages.len() as u64 > POINTS_A_ROUND);

    // The first one, whose records are trimmed, comes back behind them or not, and both trim again.
    let first = start(&cluster, 0);
    let trimmed = async {
        while cluster.nats.messages(&uid).await.1.len() > MOST_MESSAGES {
            tokio::task::yield_now().await;
        }
    };
    timeout(MAX_WAIT, trimmed).await.unwrap();
    let none_held = async {
        while figures(&pages)[held] > MOST_MESSAGES as f64 {
            tokio::task::yield_now().await;
        }
    };
    timeout(MAX_WAIT, none_held).await.unwrap();
    let expected = latest_content(&mut others).await.points;
    assert_eq!(expected.len() as u64, points);
    let mut stubs = Stubs::connect(first.uri()).await;
    assert_eq!(latest_content(&mut stubs).await.points, expected);
}

/// The revision after which the page of a server can go back, by the beginning of its stream of points.
fn oldest(pages: &str) -> u64 {
    let mut socket = TcpStream::connect(pages).unwrap();
    let request = "POST /api/v1/arm/points?max=1 HTTP/1.1\r\nHost: localhost\r\nContent-Length: 0\r\n\
                   Connection: close\r\n\r\n";
    socket.write_all(request.as_bytes()).unwrap();
    let mut answer = Vec::new();
    socket.read_to_end(&mut answer).unwrap();
    let text = String::from_utf8_lossy(&answer);
    let (_, after) = text.split_once("\"oldest_revision\":").unwrap();
    let (_, after) = after.split_once("\"number\":").unwrap();
    let digits = after.split(|it: char| !it.is_ascii_digit()).next().unwrap();
    digits.parse().unwrap()
}

#[ignore = "needs nats-server"]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn each_server_of_a_cluster_knows_its_window() {
    let cluster = Cluster::empty();
    // The second keeps the newest record alone.
    let servers = [
        cluster.start(0),
        cluster.start_with(1, &[("WAYFOLD_INDEX__WINDOW_BYTES", "1")]),
    ];
    let mut stubs = Stubs::connect(servers[0].uri()).await;
    stubs.create("arm", "R1").await;
    for id in 0..POINTS_A_ROUND {
        insert(&mut stubs, id).await.unwrap();
    }
    let newest = stubs.describe("arm").await.revision.unwrap().number;
    for (mut server, kept) in servers.into_iter().zip([newest, 1]) {
        Stubs::connect(server.uri()).await.find("arm").await;
        let pages = server.pages();
        let known = || {
            let window = "wayfold_index_window_records{index=\"arm\"}";
            (figures(&pages)[window] as u64, oldest(&pages))
        };
        let caught_up = async {
            while known() != (kept, newest - kept) {
                tokio::task::yield_now().await;
            }
        };
        assert!(timeout(MAX_WAIT, caught_up).await.is_ok(), "{:?}", known());
    }
}
