//! Servers of NATS under test, on ports of their own of the loopback interface.

use std::{
    env,
    ffi::OsStr,
    fs,
    net::TcpListener,
    path::{Path, PathBuf},
    process::Command,
};

use async_nats::jetstream::{self, message::StreamMessage, stream::Stream};

use crate::{Process, Signal};

/// The environment variable with the path of the program `nats-server`.
pub const PROGRAM: &str = "NATS_SERVER";

/// A cluster of NATS with JetStream, whose servers sync each record.
pub struct Nats {
    directory: PathBuf,
    nodes: Vec<Option<Process>>,
    hosts: Vec<Host>,
    ports: Vec<u16>,
}

/// The host of a server.
#[derive(Clone, Debug)]
pub struct Host {
    /// Its address.
    pub address: String,
    /// The command that starts a program there, and its arguments; empty for this machine.
    pub enter: Vec<String>,
}

impl Host {
    /// This machine, by its loopback interface.
    pub fn local() -> Self {
        Self {
            address: "127.0.0.1".into(),
            enter: Vec::new(),
        }
    }

    /// A command that starts a program there.
    pub fn command(&self, program: impl AsRef<OsStr>) -> Command {
        match self.enter.split_first() {
            None => Command::new(program),
            Some((enter, arguments)) => {
                let mut command = Command::new(enter);
                command.args(arguments).arg(program);
                command
            }
        }
    }
}

impl Nats {
    /// Starts this many servers, which keep their files in a directory.
    ///
    /// # Panics
    /// If they do not come up.
    pub fn start(directory: &Path, count: usize) -> Self {
        Self::start_with(directory, count, "")
    }

    /// The same with more text in the configuration of each.
    ///
    /// # Panics
    /// If they do not come up.
    pub fn start_with(directory: &Path, count: usize, more: &str) -> Self {
        Self::start_at(directory, vec![Host::local(); count], "always", more)
    }

    /// The same, each on its own host, with another interval at which they sync.
    ///
    /// # Panics
    /// If they do not come up.
    pub fn start_at(directory: &Path, hosts: Vec<Host>, sync_interval: &str, more: &str) -> Self {
        let count = hosts.len();
        let free = free_ports(2 * count);
        let (ports, routes) = free.split_at(count);
        let all = hosts.iter().zip(routes);
        let all = all.map(|(host, port)| format!("nats://{}:{port}", host.address));
        let all = all.collect::<Vec<_>>().join(", ");
        for (node, (port, route)) in ports.iter().zip(routes).enumerate() {
            let (store, address) = (store(directory, node), &hosts[node].address);
            let cluster = match count {
                1 => String::new(),
                _ => format!(
                    "cluster {{ name: test, listen: \"{address}:{route}\", routes: [{all}] }}"
                ),
            };
            let text = format!(
                "server_name: node-{node}\nlisten: \"{address}:{port}\"\n\
                 max_payload: 65536\n\
                 jetstream {{ store_dir: {store:?}, sync_interval: {sync_interval} }}\n{cluster}\n{more}\n"
            );
            fs::write(config(directory, node), text).expect("a writable directory");
        }
        let mut nats = Self {
            directory: directory.to_owned(),
            nodes: (0..count).map(|_| None).collect(),
            ports: ports.to_vec(),
            hosts,
        };
        for node in 0..count {
            nats.launch(node);
        }
        for node in nats.nodes.iter_mut().flatten() {
            node.log_until("Server is ready");
        }
        nats
    }

    /// The settings of a server that is a member of a cluster over them.
    pub fn member_settings(&self) -> [(&'static str, String); 3] {
        member_settings(&self.urls(), self.nodes.len())
    }

    /// Their URLs.
    pub fn urls(&self) -> String {
        let urls = self.hosts.iter().zip(&self.ports);
        let urls = urls.map(|(host, port)| format!("nats://{}:{port}", host.address));
        urls.collect::<Vec<_>>().join(",")
    }

    /// The directory of a server's files.
    pub fn store(&self, node: usize) -> PathBuf {
        store(&self.directory, node)
    }

    /// Sends a signal to a server.
    ///
    /// # Panics
    /// If it does not run.
    pub fn signal(&self, node: usize, signal: Signal) {
        let process = self.nodes[node].as_ref().expect("a server that runs");
        process.signal(signal);
    }

    /// Kills a server. Returns its log.
    ///
    /// # Panics
    /// If it does not run.
    pub fn kill(&mut self, node: usize) -> String {
        let killed = self.nodes[node].take().expect("a server that runs");
        killed.stop(Signal::Kill).stderr
    }

    /// Kills all servers that run.
    pub fn kill_all(&mut self) {
        self.nodes.fill_with(|| None);
    }

    /// Starts a server that was killed. Returns the log of its start.
    ///
    /// # Panics
    /// If it does not come up.
    pub fn restart(&mut self, node: usize) -> Vec<String> {
        self.launch(node);
        let started = self.nodes[node].as_mut().expect("a server that runs");
        started.log_until("Server is ready")
    }

    /// Removes the message of an index that ends with the record of a revision, as damage to the store of NATS would; false
    /// if there is none.
    ///
    /// # Panics
    /// If NATS does not answer.
    pub async fn remove_record(&self, uid: &str, revision: u64) -> bool {
        let (stream, messages) = self.messages(uid).await;
        let revision = revision.to_string();
        let is_it = |message: &&StreamMessage| {
            let last = message.headers.get("Wayfold-Last");
            last.is_some_and(|last| last.as_str() == revision)
        };
        let Some(message) = messages.iter().find(is_it) else {
            return false;
        };
        let removed = stream.delete_message(message.sequence).await;
        removed.expect("an answer of NATS")
    }

    /// Adds a message that no server writes to the journal of an index.
    ///
    /// # Panics
    /// If NATS does not take it.
    pub async fn damage(&self, uid: &str) {
        let (_, messages) = self.messages(uid).await;
        let client = async_nats::connect(self.urls()).await;
        let context = jetstream::new(client.expect("a connection to NATS"));
        let sent = context.publish(messages[0].subject.clone(), "damaged".into());
        let acknowledged = sent.await.expect("a connection to NATS").await;
        acknowledged.expect("an acknowledgement of NATS");
    }

    /// The messages of an index, and their stream.
    ///
    /// # Panics
    /// If NATS does not answer.
    pub async fn messages(&self, uid: &str) -> (Stream, Vec<StreamMessage>) {
        let client = async_nats::connect(self.urls()).await;
        let context = jetstream::new(client.expect("a connection to NATS"));
        // The stream of an index depends on its uid.
        for number in 0..4 {
            let stream = context.get_stream(format!("wayfold-log-{number}")).await;
            let stream = stream.expect("a stream of Wayfold");
            let subject = format!("wayfold.log.{number}.{uid}");
            let (mut messages, mut next) = (Vec::new(), 1);
            while let Ok(message) = stream
                .get_first_raw_message_by_subject(&*subject, next)
                .await
            {
                next = message.sequence + 1;
                messages.push(message);
            }
            if !messages.is_empty() {
                return (stream, messages);
            }
        }
        panic!("NATS has no message of the index {uid}");
    }

    fn launch(&mut self, node: usize) {
        let program = env::var(PROGRAM).expect("NATS_SERVER, the path of the program nats-server");
        let config = config(&self.directory, node);
        let config = config.to_str().expect("a path in UTF-8");
        let mut command = self.hosts[node].command(program);
        self.nodes[node] = Some(Process::spawn(command.args(["--config", config])));
    }
}

/// The settings of a server of Wayfold that is a member of a cluster, by the names of their environment variables.
pub fn member_settings(urls: &str, replicas: usize) -> [(&'static str, String); 3] {
    [
        ("WAYFOLD_CLUSTER__NATS", urls.to_owned()),
        ("WAYFOLD_CLUSTER__REPLICAS", replicas.to_string()),
        ("WAYFOLD_CLUSTER__LISTEN", "127.0.0.1:0".into()),
    ]
}

fn store(directory: &Path, node: usize) -> PathBuf {
    directory.join(format!("nats-{node}"))
}

fn config(directory: &Path, node: usize) -> PathBuf {
    directory.join(format!("nats-{node}.conf"))
}

/// Ports that were free a moment ago: NATS has to know the ports of the others before it starts.
fn free_ports(count: usize) -> Vec<u16> {
    let listeners = (0..count).map(|_| TcpListener::bind("127.0.0.1:0").expect("a free port"));
    let listeners: Vec<_> = listeners.collect();
    let addresses = listeners
        .iter()
        .map(|it| it.local_addr().expect("an address"));
    addresses.map(|address| address.port()).collect()
}
