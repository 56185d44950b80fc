//! The servers of both kinds, and what they run on.

use std::{
    env,
    path::PathBuf,
    sync::{Arc, Mutex},
    time::SystemTime,
};

use tokio::{task::yield_now, time::timeout};
use wayfold_tests::{
    Process, ServerProcess, Signal,
    nats::{Host, Nats},
};

use super::{
    MAX_PAUSE,
    clock::Clocks,
    disk::Disk,
    fault::{Fault, Needs},
    network::Network,
    notices::{Notices, lacks_leader},
};
use crate::metrics::figures;

pub(super) const SERVERS: usize = 3;
pub(super) const NATS_SERVERS: usize = 3;

/// The servers, and the addresses that clients know.
pub(super) struct Cluster {
    pub(super) nats: Nats,
    pub(super) servers: Vec<Option<ServerProcess>>,
    pub(super) uris: Arc<Mutex<Vec<String>>>,
    /// The addresses of the pages of the servers.
    pages: Vec<String>,
    pub(super) clocks: Clocks,
    /// The disks of the servers and then of those of NATS, if a fault needs them.
    pub(super) disks: Vec<Disk>,
    /// The same for the network, whose places have the same order.
    pub(super) network: Option<Network>,
    /// The notices in the logs of killed servers.
    pub(super) notices: Notices,
    trims: bool,
    directory: tempfile::TempDir,
}

impl Cluster {
    /// Starts all servers. Those that trim keep no record of the journal for longer than a second: most servers that come
    /// back are behind it then, and take a copy. With those that do not, damage to NATS hits records that servers need.
    pub(super) fn start(kinds: &[Fault], trims: bool) -> Self {
        let directory = tempfile::tempdir().unwrap();
        let needs = |what| kinds.iter().any(|kind| kind.needs() == what);
        let mut disks = Vec::new();
        if needs(Needs::Disks) {
            for number in 0..SERVERS + NATS_SERVERS {
                let mount = match number.checked_sub(SERVERS) {
                    None => format!("data-{number}"),
                    Some(node) => format!("nats-{node}"),
                };
                let image = directory.path().join(format!("disk-{number}"));
                disks.push(Disk::new(image, directory.path().join(mount)));
            }
        }
        let network = needs(Needs::Network).then(|| Network::new(SERVERS + NATS_SERVERS));
        let hosts = (0..NATS_SERVERS).map(|node| host(network.as_ref(), SERVERS + node));
        let sync_interval = env::var("CLUSTER_NATS_SYNC").unwrap_or_else(|_| "always".into());
        let nats = Nats::start_at(
            directory.path(),
            hosts.collect(),
            &sync_interval,
            "logtime_utc: true",
        );
        let mut cluster = Self {
            nats,
            servers: (0..SERVERS).map(|_| None).collect(),
            uris: Arc::new(Mutex::new(vec![String::new(); SERVERS])),
            pages: vec![String::new(); SERVERS],
            clocks: Clocks::new(directory.path(), SERVERS),
            disks,
            network,
            notices: Notices::default(),
            trims,
            directory,
        };
        cluster.start_servers(&[0, 1, 2]);
        cluster
    }

    pub(super) fn data(&self, server: usize) -> PathBuf {
        // A disk has files of its own beside those of the server.
        self.directory.path().join(format!("data-{server}/files"))
    }

    /// Removes the data of a server, which is stopped.
    pub(super) fn lose_data(&self, server: usize) {
        std::fs::remove_dir_all(self.data(server)).unwrap();
    }

    /// Starts servers. One that ends instead, as it does without NATS, stays away.
    pub(super) fn start_servers(&mut self, servers: &[usize]) {
        let started: Vec<_> = servers.iter().map(|server| self.launch(*server)).collect();
        for (&server, mut process) in servers.iter().zip(started) {
            let Some(line) = process.line() else {
                let log = process.finish().stderr;
                println!("server {server} has not started:\n{log}");
                self.notices.read(server, &log);
                continue;
            };
            let mut process = ServerProcess::listening(process, &line);
            self.pages[server] = process.pages();
            self.uris.lock().unwrap()[server] = process.uri().to_owned();
            self.servers[server] = Some(process);
        }
    }

    fn launch(&self, server: usize) -> Process {
        let host = host(self.network.as_ref(), server);
        let mut command = host.command(env!("CARGO_BIN_EXE_server-process"));
        let listen = format!("{}:0", host.address);
        let network = self.network.as_ref();
        let front = network.map(|network| format!("{}:0", network.front(server)));
        let front = front.as_ref().unwrap_or(&listen);
        command
            .args(["--grpc", front, "--http", front, "--data"])
            .arg(self.data(server))
            .envs(self.nats.member_settings())
            .env("WAYFOLD_CLUSTER__LISTEN", listen)
            .envs(self.clocks.environment(server))
            .env("WAYFOLD_INDEX__GROWING_ROWS", "32")
            // A server without a processor would shed calls.
            .env("WAYFOLD_ADMISSION__QUEUE_TARGET_MS", "60000");
        if self.network.is_some() {
            command.arg("--insecure");
        }
        if self.trims {
            command.env("WAYFOLD_INDEX__WINDOW_SECONDS", "1");
        }
        Process::spawn(&mut command)
    }

    /// The server that owns the index, once one alone believes so.
    pub(super) async fn owner(&self) -> usize {
        const OWNED: &str = "wayfold_index_owned{index=\"arm\"}";
        let owns = |pages: &String| figures(pages).get(OWNED) == Some(&1.0);
        let only = async {
            loop {
                let owners = (0..SERVERS).filter(|&server| owns(&self.pages[server]));
                match owners.collect::<Vec<_>>()[..] {
                    [owner] => return owner,
                    _ => yield_now().await,
                }
            }
        };
        timeout(MAX_PAUSE, only).await.expect("one owner")
    }

    /// True if all servers run.
    pub(super) fn is_whole(&self) -> bool {
        self.servers.iter().all(Option::is_some)
    }

    /// The addresses of the servers that run.
    pub(super) fn live_uris(&self) -> Vec<String> {
        let live = self.servers.iter().flatten();
        live.map(|server| server.uri().to_owned()).collect()
    }

    /// Kills a server, if it runs.
    pub(super) fn kill(&mut self, server: usize) {
        if let Some(killed) = self.servers[server].take() {
            let log = killed.stop(Signal::Kill).stderr;
            self.notices.read(server, &log);
        }
    }

    pub(super) fn kill_nats(&mut self, node: usize) {
        let log = self.nats.kill(node);
        self.notices.read_nats(&log);
    }

    /// Kills all servers of NATS, because nothing was acknowledged since this time; false if their logs do not blame them.
    pub(super) fn has_jetstream_stopped(&mut self, since: SystemTime) -> bool {
        let logs: Vec<_> = (0..NATS_SERVERS).map(|node| self.nats.kill(node)).collect();
        logs.iter().for_each(|log| self.notices.read_nats(log));
        let blamed = logs.iter().filter(|log| lacks_leader(log, since));
        let has_stopped = 2 * blamed.count() > NATS_SERVERS;
        if !has_stopped {
            logs.iter().for_each(|log| println!("{log}"));
        }
        has_stopped
    }

    /// Kills all servers of both kinds, and starts them again; false if a server has not started.
    pub(super) fn kill_all(&mut self) -> bool {
        for server in 0..SERVERS {
            self.kill(server);
        }
        for node in 0..NATS_SERVERS {
            self.kill_nats(node);
        }
        for node in 0..NATS_SERVERS {
            self.nats.restart(node);
        }
        self.start_servers(&[0, 1, 2]);
        self.is_whole()
    }

    pub(super) fn signal(&self, server: usize, signal: Signal) {
        let process = self.servers[server].as_ref().unwrap().process();
        process.signal(signal);
    }
}

impl Drop for Cluster {
    fn drop(&mut self) {
        if std::thread::panicking() {
            for line in &self.notices.lines {
                println!("{line}");
            }
        }
        // The processes end before their disks and their network do.
        self.servers.clear();
        self.nats.kill_all();
    }
}

/// The host at a place of the network, or this machine.
fn host(network: Option<&Network>, place: usize) -> Host {
    network.map_or_else(Host::local, |network| network.host(place))
}
