//! Servers that share a journal in NATS, while servers of both kinds are killed and stand still under their writers: each
//! acknowledged mutation takes effect once, and all servers have the same points.

use std::{
    path::PathBuf,
    process::Command,
    sync::{Arc, Mutex},
    time::Duration,
};

use rand::{RngExt, SeedableRng, seq::IndexedRandom};
use rand_chacha::ChaCha8Rng;
use tokio::{sync::watch, task::JoinSet, time::timeout};
use tonic::{Code, transport::Endpoint};
use wayfold_proto::v1::GetRequest;
use wayfold_tests::{
    Content, Model, Process, ServerProcess, Signal, Stubs, ledger::Entry, nats::Nats, revision,
};

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
/// A client moves to another server after this many calls.
const CALLS_A_SERVER: usize = 10;
/// The time in which writing goes on after a fault; NATS alone may take ten seconds to choose another leader.
const MAX_PAUSE: Duration = Duration::from_secs(60);
/// The silence of a server after which a writer probes it, and after which it leaves.
const MAX_SILENCE: Duration = Duration::from_secs(1);

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

/// Connects as a client that leaves a server which stands still.
async fn connect(uri: &str) -> Result<Stubs, tonic::transport::Error> {
    let endpoint = Endpoint::from_shared(uri.to_owned()).expect("a URI");
    let endpoint = endpoint.http2_keep_alive_interval(MAX_SILENCE);
    Stubs::open(&endpoint.keep_alive_timeout(MAX_SILENCE)).await
}

/// Writes at one server after the other, until `over`.
async fn write(
    mut writer: Writer,
    uris: Arc<Mutex<Vec<String>>>,
    acknowledged: watch::Sender<u64>,
    over: watch::Receiver<bool>,
) -> Writer {
    let mut random = ChaCha8Rng::seed_from_u64(writer.name);
    while !*over.borrow() {
        let uri = uris.lock().unwrap().choose(&mut random).unwrap().clone();
        let Ok(stubs) = connect(&uri).await else {
            tokio::task::yield_now().await;
            continue;
        };
        writer = writer
            .write(stubs, acknowledged.clone(), CALLS_A_SERVER)
            .await;
        if let Some(refusal) = &writer.refusal {
            let is_expected = matches!(
                refusal.code(),
                Code::Unavailable | Code::Unknown | Code::Internal | Code::Cancelled
            );
            assert!(is_expected, "{refusal:?}");
        }
    }
    writer
}

#[ignore = "needs nats-server"]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn servers_that_share_a_journal_lose_and_double_nothing() {
    let seed = variable("CLUSTER_SEED", SEED);
    println!("seed {seed}");
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut cluster = Cluster::start();
    let first = cluster.uris.lock().unwrap()[0].clone();
    let mut stubs = Stubs::connect(&first).await;
    let uid = stubs.create("arm", SPACE).await.revision.unwrap().uid;
    let mut writers: Vec<_> = (0..WRITERS)
        .map(|name| Writer::new(name, seed, LOAD))
        .collect();
    for writer in writers.iter_mut().skip(1).step_by(2) {
        writer.open_session(&mut stubs, &uid).await;
    }
    let (acknowledged, over) = (watch::Sender::new(0), watch::Sender::new(false));
    let mut writing = JoinSet::new();
    for writer in writers {
        let uris = Arc::clone(&cluster.uris);
        writing.spawn(write(writer, uris, acknowledged.clone(), over.subscribe()));
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
    let mut writers = writing.join_all().await;
    let uris = cluster.uris.lock().unwrap().clone();
    let mut stubs = Stubs::connect(&uris[0]).await;
    for writer in &mut writers {
        writer.resolve(&mut stubs).await;
    }

    let mut entries: Vec<Entry> = writers
        .iter_mut()
        .flat_map(|it| it.ledger.drain(..))
        .collect();
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
    for uri in &uris {
        let stubs = Stubs::connect(uri).await;
        let request = GetRequest {
            index_name: "arm".into(),
            min_revision: revision(&uid, newest),
            ..Default::default()
        };
        stubs.points.clone().get(request).await.unwrap();
        let content = Content::read(&stubs, "arm").await.unwrap();
        model.check_content(&content);
        tally.count(&content);
    }
    println!("{tally}; {} copies taken of other servers", cluster.copies);
    assert_eq!((tally.lost, tally.duplicated), (0, 0));
}
