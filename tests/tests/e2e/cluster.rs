//! Servers that share a journal in NATS, while servers of both kinds are killed and stand still under their writers: each
//! acknowledged mutation takes effect once, all servers have the same points, and the history of the clients holds.

mod client;
mod history;

use std::{
    path::PathBuf,
    process::Command,
    sync::{Arc, Mutex},
    time::{Duration, Instant},
};

use rand::{RngExt, SeedableRng, seq::IndexedRandom};
use rand_chacha::ChaCha8Rng;
use tokio::{sync::watch, task::JoinSet, time::timeout};
use wayfold_proto::v1::GetRequest;
use wayfold_tests::{
    Content, Model, Process, ServerProcess, Signal, Stubs, history::check, ledger::Entry,
    nats::Nats, revision,
};

use client::{Client, Scene};
use history::{History, scan};

use crate::{
    clients::{Load, SPACE, Tally, Writer},
    healing::HEALED,
};

const SERVERS: usize = 3;
const NATS_SERVERS: usize = 3;
const WRITERS: u64 = 8;
const LOAD: Load = Load {
    rows: 20,
    // Such a call takes several messages of NATS.
    heavy: 0.05,
    removals: 0.2,
};
/// The number of faults, unless the environment variable `CLUSTER_FAULTS` sets another.
const FAULTS: u64 = 6;
/// The seed, unless `CLUSTER_SEED` sets another.
const SEED: u64 = 5;
/// The time in which writing goes on after a fault; NATS alone may take ten seconds to choose another leader.
const MAX_PAUSE: Duration = Duration::from_secs(60);

fn variable(name: &str, default: u64) -> u64 {
    std::env::var(name).map_or(default, |value| value.parse().unwrap())
}

/// A fault under the writers.
#[derive(Clone, Copy, Debug)]
enum Fault {
    /// A server is killed, and started again once writing has gone on without it.
    Kill,
    /// A server is killed and loses its data directory.
    Lose,
    /// A server stands still for as long as writing goes on without it.
    Pause,
    /// A server of NATS is killed.
    KillNats,
    /// All servers of both kinds are killed at once.
    KillAll,
}

/// The servers, and the addresses that clients know.
struct Cluster {
    directory: tempfile::TempDir,
    nats: Nats,
    servers: Vec<Option<ServerProcess>>,
    uris: Arc<Mutex<Vec<String>>>,
    /// The copies that killed servers had taken of others.
    copies: usize,
}

impl Cluster {
    fn start() -> Self {
        let directory = tempfile::tempdir().unwrap();
        let nats = Nats::start(directory.path(), NATS_SERVERS);
        let mut cluster = Self {
            directory,
            nats,
            servers: (0..SERVERS).map(|_| None).collect(),
            uris: Arc::new(Mutex::new(vec![String::new(); SERVERS])),
            copies: 0,
        };
        cluster.start_servers(&[0, 1, 2]);
        cluster
    }

    fn data(&self, server: usize) -> PathBuf {
        self.directory.path().join(format!("data-{server}"))
    }

    fn start_servers(&mut self, servers: &[usize]) {
        let started: Vec<_> = servers.iter().map(|server| self.launch(*server)).collect();
        for (&server, process) in servers.iter().zip(started) {
            let process = ServerProcess::ready(process);
            self.uris.lock().unwrap()[server] = process.uri().to_owned();
            self.servers[server] = Some(process);
        }
    }

    fn launch(&self, server: usize) -> Process {
        let mut command = Command::new(env!("CARGO_BIN_EXE_server-process"));
        command
            .args(["--grpc", "127.0.0.1:0", "--data"])
            .arg(self.data(server))
            .envs(self.nats.member_settings())
            .env("WAYFOLD_INDEX__GROWING_ROWS", "32")
            // Most servers that come back are behind what NATS keeps, and take a copy.
            .env("WAYFOLD_INDEX__WINDOW_SECONDS", "1")
            // A server without a processor would shed calls.
            .env("WAYFOLD_ADMISSION__QUEUE_TARGET_MS", "60000");
        Process::spawn(&mut command)
    }

    fn kill(&mut self, server: usize) {
        let killed = self.servers[server].take().unwrap();
        let log = killed.stop(Signal::Kill).stderr;
        self.copies += log.matches(HEALED).count();
    }

    fn kill_all(&mut self) {
        for server in 0..SERVERS {
            self.kill(server);
        }
        for node in 0..NATS_SERVERS {
            self.nats.kill(node);
        }
        for node in 0..NATS_SERVERS {
            self.nats.restart(node);
        }
        self.start_servers(&[0, 1, 2]);
    }

    /// Causes a fault, waits with `go_on` until writing has gone on, and repairs it.
    async fn suffer(&mut self, fault: Fault, of: usize, go_on: impl AsyncFnOnce()) {
        println!("{fault:?} of {of}");
        match fault {
            Fault::Kill => {
                self.kill(of);
                go_on().await;
                self.start_servers(&[of]);
            }
            Fault::Lose => {
                self.kill(of);
                std::fs::remove_dir_all(self.data(of)).unwrap();
                go_on().await;
                self.start_servers(&[of]);
            }
            Fault::Pause => {
                let process = self.servers[of].as_ref().unwrap().process();
                process.signal(Signal::Pause);
                go_on().await;
                process.signal(Signal::Resume);
            }
            Fault::KillNats => {
                self.nats.kill(of);
                go_on().await;
                self.nats.restart(of);
            }
            Fault::KillAll => {
                self.kill_all();
                go_on().await;
            }
        }
    }
}

#[ignore = "needs nats-server"]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn servers_that_share_a_journal_lose_and_double_nothing() {
    let seed = variable("CLUSTER_SEED", SEED);
    println!("seed {seed}");
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut cluster = Cluster::start();
    let first = cluster.uris.lock().unwrap()[0].clone();
    let history = History::new();
    let mut stubs = Stubs::connect(&first).await;
    let uid = stubs.create("arm", SPACE).await.revision.unwrap().uid;
    let mut writers: Vec<_> = (0..WRITERS)
        .map(|name| Writer::new(name, seed, LOAD))
        .collect();
    for writer in writers.iter_mut().skip(1).step_by(2) {
        writer.open_session(&mut stubs, &uid).await;
    }
    let (acknowledged, over) = (watch::Sender::new(0), watch::Sender::new(false));
    let scene = Scene {
        uid: uid.clone(),
        uris: Arc::clone(&cluster.uris),
        history,
        acknowledged: acknowledged.clone(),
        over: over.subscribe(),
    };
    let mut working = JoinSet::new();
    for writer in writers {
        working.spawn(Client::new(writer).work(scene.clone()));
    }
    let mut at = acknowledged.subscribe();
    let mut reach_more = async |more: u64| {
        let wanted = *at.borrow() + more;
        let reached = timeout(MAX_PAUSE, at.wait_for(|&now| now >= wanted)).await;
        assert!(reached.is_ok(), "nothing is acknowledged any more");
    };
    let faults = [
        Fault::Kill,
        Fault::Lose,
        Fault::Pause,
        Fault::KillNats,
        Fault::KillAll,
    ];
    for number in 0..variable("CLUSTER_FAULTS", FAULTS) {
        // The first faults are one of each kind.
        let fault = match faults.get(number as usize) {
            Some(fault) => *fault,
            None => *faults.choose(&mut random).unwrap(),
        };
        reach_more(random.random_range(20..100)).await;
        let of = random.random_range(0..SERVERS);
        cluster
            .suffer(fault, of, async || reach_more(20).await)
            .await;
    }
    over.send_replace(true);
    cluster.kill_all();
    let mut clients = working.join_all().await;
    let uris = cluster.uris.lock().unwrap().clone();
    let mut stubs = Stubs::connect(&uris[0]).await;
    let (mut entries, mut operations) = (Vec::new(), Vec::new());
    for client in &mut clients {
        let writer = &mut client.writer;
        writer.resolve(&mut stubs).await;
        operations.append(&mut client.reads);
        for acknowledged in writer.ledger.drain(..) {
            operations.push(history.mutation(writer.name, &acknowledged));
            entries.push(acknowledged.entry);
        }
    }
    entries.sort_by_key(Entry::revision);
    let (mut tally, mut model) = (Tally::default(), Model::new(SPACE.parse().unwrap()));
    for entry in &entries {
        tally.note(entry);
        model.skip_to(entry.revision() - 1);
        model.check(entry);
    }
    // Retries may have left records without effect behind the last mutation.
    let newest = Content::read(&stubs, "arm").await.unwrap().revision;
    assert!(newest >= model.revision());
    model.skip_to(newest);
    for (server, uri) in uris.iter().enumerate() {
        let (stubs, invoked) = (Stubs::connect(uri).await, Instant::now());
        let request = GetRequest {
            index_name: "arm".into(),
            min_revision: revision(&uid, newest),
            ..Default::default()
        };
        stubs.points.clone().get(request).await.unwrap();
        let content = Content::read(&stubs, "arm").await.unwrap();
        model.check_content(&content);
        tally.count(&content);
        let read = scan(false, &content);
        let reader = WRITERS + server as u64;
        operations.push(history.operation(reader, invoked, Instant::now(), read));
    }
    let checked = check(&operations);
    println!("{checked:?}");
    assert!(checked.is_ok());
    println!("{tally}; {} copies taken of other servers", cluster.copies);
    assert_eq!((tally.lost, tally.duplicated), (0, 0));
}
