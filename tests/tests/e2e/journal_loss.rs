//! NATS loses records that it had acknowledged: its store is set back to an earlier state. Servers that have applied them
//! notice it and publish them again. The environment variable `NATS_SERVER` has the path of the program
//! nats-server.

use std::{ops::Range, path::PathBuf, process::Command, time::Duration};

use tempfile::TempDir;
use tokio::time::timeout;
use wayfold_proto::v1::InsertRequest;
use wayfold_tests::{Content, Process, ServerProcess, Signal, Stubs, nats::Nats, row_states};

const KEPT: u64 = 50;
const LOST: u64 = 300;
/// NATS comes back, and the servers look at it each second.
pub(crate) const MAX_WAIT: Duration = Duration::from_secs(60);

/// One server of NATS, and servers with a data directory each.
pub(crate) struct Cluster {
    directory: TempDir,
    pub(crate) nats: Nats,
}

impl Cluster {
    /// A cluster without a server of Wayfold.
    pub(crate) fn empty() -> Self {
        let directory = tempfile::tempdir().unwrap();
        let nats = Nats::start(directory.path(), 1);
        Self { directory, nats }
    }

    pub(crate) fn start(&self, number: usize) -> ServerProcess {
        self.start_with(number, &[])
    }

    /// Starts a server with these settings too.
    pub(crate) fn start_with(&self, number: usize, settings: &[(&str, &str)]) -> ServerProcess {
        let mut command = Command::new(env!("CARGO_BIN_EXE_server-process"));
        command
            .args(["--grpc", "127.0.0.1:0", "--http", "127.0.0.1:0", "--data"])
            .arg(self.data(number))
            .envs(self.nats.member_settings())
            .envs(settings.iter().copied());
        ServerProcess::ready(Process::spawn(&mut command))
    }

    fn data(&self, number: usize) -> PathBuf {
        self.directory.path().join(format!("data-{number}"))
    }

    /// Starts a new generation of the index "arm" from the directory of a server, which is stopped.
    pub(crate) fn reseed(&self, number: usize) {
        let reseeded = Command::new(env!("CARGO_BIN_EXE_server-process"))
            .args(["reseed", "arm", "--data"])
            .arg(self.data(number))
            .envs(self.nats.member_settings())
            .output()
            .unwrap();
        assert!(reseeded.status.success(), "{reseeded:?}");
        let text = String::from_utf8(reseeded.stdout).unwrap();
        assert!(text.contains("index arm goes on as "), "{text}");
    }

    /// NATS loses all that it has.
    pub(crate) fn lose_store(&mut self) {
        self.nats.kill(0);
        std::fs::remove_dir_all(self.store()).unwrap();
        self.nats.restart(0);
    }

    /// Removes the data directory of a server, which is stopped.
    pub(crate) fn lose(&self, number: usize) {
        std::fs::remove_dir_all(self.data(number)).unwrap();
    }

    /// Kills NATS, and starts it again once its store is copied.
    pub(crate) fn save_store(&mut self) {
        self.nats.kill(0);
        Self::copy(&self.store(), &self.saved());
        self.nats.restart(0);
    }

    /// Kills NATS, and starts it again on the store that was copied.
    pub(crate) fn set_store_back(&mut self) {
        self.nats.kill(0);
        self.put_store_back();
    }

    /// The same for a server of NATS that is killed.
    fn put_store_back(&mut self) {
        std::fs::remove_dir_all(self.store()).unwrap();
        Self::copy(&self.saved(), &self.store());
        self.nats.restart(0);
    }

    fn saved(&self) -> PathBuf {
        self.directory.path().join("copy")
    }

    fn store(&self) -> PathBuf {
        self.directory.path().join("nats-0")
    }

    /// Copies the store of NATS, which is stopped.
    fn copy(from: &PathBuf, to: &PathBuf) {
        let copied = Command::new("cp")
            .arg("-a")
            .args([from, to])
            .status()
            .unwrap();
        assert!(copied.success());
    }
}

/// Inserts a point. Its id is the operation too, so a repetition takes effect once.
pub(crate) async fn insert(stubs: &mut Stubs, id: u64) -> Result<(), tonic::Status> {
    let request = InsertRequest {
        index_name: "arm".into(),
        states: Some(row_states(&[id as f64], 1)),
        ids: vec![id],
        operation_id: format!("insert {id}"),
        ..Default::default()
    };
    stubs.points.insert(request).await.map(drop)
}

/// Inserts these points, each again until it is acknowledged.
pub(crate) async fn insert_until_acknowledged(stubs: &mut Stubs, ids: Range<u64>) {
    for id in ids {
        while insert(stubs, id).await.is_err() {
            tokio::task::yield_now().await;
        }
    }
}

/// With `restart` the servers are killed too, and know the lost records only from their data directories.
async fn lose(restart: bool) {
    let mut cluster = Cluster::empty();
    let mut servers: Vec<_> = (0..2).map(|number| cluster.start(number)).collect();
    let mut stubs = Stubs::connect(servers[0].uri()).await;
    stubs.create("arm", "R1").await;
    for id in 0..KEPT {
        insert(&mut stubs, id).await.unwrap();
    }
    cluster.save_store();
    insert_until_acknowledged(&mut stubs, KEPT..KEPT + LOST).await;
    let mut other = Stubs::connect(servers[1].uri()).await;
    other.latest("arm").await.unwrap();

    cluster.nats.kill(0);
    if restart {
        for server in servers.drain(..) {
            server.stop(Signal::Kill);
        }
    }
    cluster.put_store_back();
    if restart {
        servers = (0..2).map(|number| cluster.start(number)).collect();
    }

    let mut stubs = Stubs::connect(servers[0].uri()).await;
    let written = insert_until_acknowledged(&mut stubs, KEPT + LOST..KEPT + LOST + 1);
    timeout(MAX_WAIT, written).await.unwrap();
    // A server without a directory has them from the journal alone.
    servers.push(cluster.start(2));
    let mut contents = Vec::new();
    for server in &servers {
        let mut stubs = Stubs::connect(server.uri()).await;
        let caught_up = async { while stubs.latest("arm").await.is_err() {} };
        timeout(MAX_WAIT, caught_up).await.unwrap();
        let content = Content::read(&stubs, "arm").await.unwrap();
        contents.push(content.points.keys().copied().collect::<Vec<u64>>());
    }
    let expected: Vec<u64> = (0..=KEPT + LOST).collect();
    assert!(contents.iter().all(|ids| *ids == expected));
    servers.pop();
    let logs: Vec<_> = servers
        .into_iter()
        .map(|server| server.stop(Signal::Kill).stderr)
        .collect();
    let noticed = "the journal had lost its newest records";
    assert!(logs.iter().any(|log| log.contains(noticed)), "{logs:?}");
}

#[ignore = "needs nats-server"]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn records_that_nats_loses_come_back_from_a_server() {
    lose(false).await;
}

#[ignore = "needs nats-server"]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn records_that_nats_loses_come_back_from_a_data_directory() {
    lose(true).await;
}
