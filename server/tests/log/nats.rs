//! A server of NATS under test, and the logs in it.

use std::{
    env, fs,
    io::{BufRead, BufReader},
    process::{Child, Command, Stdio},
    sync::Arc,
    time::Duration,
};

use tempfile::TempDir;
use tokio::{
    runtime::{Builder, Runtime},
    time::timeout,
};
use wayfold_server::log::{
    Catalogue, Log, LogError, MemoryLog, NatsOptions, Receipt, Record, Uid, connect_nats,
};

/// A server of NATS with JetStream, on a port of its own of the loopback interface. It is killed when it is dropped.
pub(crate) struct NatsServer {
    child: Child,
    url: String,
    _files: TempDir,
}

impl NatsServer {
    /// Starts the program that the environment variable `NATS_SERVER` names.
    pub(crate) fn start() -> Self {
        // Many packs of records take several messages of so few bytes.
        Self::start_with("max_payload: 1300")
    }

    /// The same with this text in its configuration.
    pub(crate) fn start_with(more: &str) -> Self {
        let program = env::var_os("NATS_SERVER").expect("NATS_SERVER, the path of nats-server");
        let files = tempfile::tempdir().unwrap();
        let config = files.path().join("nats.conf");
        let store = files.path().join("store");
        let text =
            format!("listen: \"127.0.0.1:-1\"\njetstream {{ store_dir: {store:?} }}\n{more}\n");
        fs::write(&config, text).unwrap();
        let mut child = Command::new(program)
            .arg("--config")
            .arg(config)
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let mut url = None;
        let mut lines = BufReader::new(child.stderr.take().unwrap()).lines();
        for line in lines.by_ref().map_while(Result::ok) {
            if let Some((_, address)) = line.split_once("Listening for client connections on ") {
                url = Some(format!("nats://{address}"));
            }
            if line.contains("Server is ready") {
                break;
            }
        }
        // The pipe is read until the server ends, so that the server never blocks on it.
        std::thread::spawn(move || lines.count());
        Self {
            child,
            url: url.expect("a server that listens"),
            _files: files,
        }
    }

    /// The options of a log in this server.
    pub(crate) fn options(&self) -> NatsOptions {
        NatsOptions {
            servers: self.url.clone(),
            name: "wayfold".into(),
            replicas: 1,
            min_payload: 0,
            credentials: None,
            ca: None,
        }
    }

    /// Sends the process a signal of this name.
    pub(crate) fn signal(&self, name: &str) {
        let mut kill = Command::new("kill");
        kill.args(["-s", name, &self.child.id().to_string()]);
        assert!(kill.status().unwrap().success());
    }
}

impl Drop for NatsServer {
    fn drop(&mut self) {
        // Both fail only if it has ended.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// A server of NATS, and the runtime of the logs in it.
pub(crate) struct Nats {
    pub(crate) runtime: Runtime,
    pub(crate) server: NatsServer,
}

impl Nats {
    pub(crate) fn start() -> Self {
        Self::of(NatsServer::start())
    }

    pub(crate) fn of(server: NatsServer) -> Self {
        let runtime = Builder::new_multi_thread().enable_all().build().unwrap();
        Self { runtime, server }
    }

    /// Another server's connection, with this store of its own.
    pub(crate) fn connect(&self, local: Arc<MemoryLog>) -> Log {
        self.connect_with(&self.server.options(), local)
    }

    pub(crate) fn connect_with(&self, options: &NatsOptions, local: Arc<MemoryLog>) -> Log {
        let _entered = self.runtime.enter();
        connect_nats(options, local).unwrap().0
    }

    /// Submits a record, and waits for its receipt.
    pub(crate) fn submit(&self, log: &Log, uid: Uid, record: &Arc<Record>) -> Result<(), LogError> {
        let Receipt::Awaited(receipt) = log.journal.submit(uid, Arc::clone(record))? else {
            panic!("a journal elsewhere accepts nothing at once");
        };
        self.runtime.block_on(receipt)
    }

    /// Submits a record, and waits until the journal has it.
    pub(crate) fn publish(&self, log: &Log, uid: Uid, record: &Arc<Record>) {
        self.submit(log, uid, record).unwrap();
    }

    /// Waits until a server knows of a change.
    pub(crate) fn until(&self, log: &Log, is_known: impl Fn(&dyn Catalogue) -> bool) {
        let mut changes = log.catalogue.changes().unwrap();
        while !is_known(&*log.catalogue) {
            let change = async { timeout(Duration::from_secs(60), changes.changed()).await };
            self.runtime.block_on(change).unwrap().unwrap();
        }
    }
}
