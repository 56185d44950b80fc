//! A server of NATS under test.

use std::{
    env, fs,
    io::{BufRead, BufReader},
    process::{Child, Command, Stdio},
    time::Duration,
};

use tempfile::TempDir;
use tokio::{runtime::Runtime, time::timeout};
use wayfold_server::log::{Catalogue, NatsOptions};

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

/// Waits until a server knows of a change.
pub(crate) fn until(runtime: &Runtime, catalogue: &dyn Catalogue, is_known: impl Fn() -> bool) {
    let mut changes = catalogue.changes().unwrap();
    while !is_known() {
        let change = async { timeout(Duration::from_secs(60), changes.changed()).await };
        runtime.block_on(change).unwrap().unwrap();
    }
}
