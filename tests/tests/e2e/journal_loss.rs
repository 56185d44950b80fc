//! NATS loses records that it had acknowledged: its store is set back to an earlier state. Servers that have applied them
//! notice it and publish them again. The environment variable `NATS_SERVER` has the path of the program
//! nats-server.

use std::{path::PathBuf, process::Command, time::Duration};

use tempfile::TempDir;
use tokio::time::timeout;
use wayfold_proto::v1::InsertRequest;
use wayfold_tests::{Content, Process, ServerProcess, Signal, Stubs, nats::Nats, row_states};

const KEPT: u64 = 50;
const LOST: u64 = 300;
/// NATS comes back, and the servers look at it each second.
const MAX_WAIT: Duration = Duration::from_secs(60);

struct Cluster {
    directory: TempDir,
    nats: Nats,
}

impl Cluster {
    fn start(&self, number: usize) -> ServerProcess {
        let mut command = Command::new(env!("CARGO_BIN_EXE_server-process"));
        command
            .args(["--grpc", "127.0.0.1:0", "--data"])
            .arg(self.directory.path().join(format!("data-{number}")))
            .envs(self.nats.member_settings());
        ServerProcess::ready(Process::spawn(&mut command))
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
async fn insert(stubs: &mut Stubs, id: u64) -> Result<(), tonic::Status> {
    let request = InsertRequest {
        index_name: "arm".into(),
        states: Some(row_states(&[id as f64], 1)),
        ids: vec![id],
        operation_id: format!("insert {id}"),
        ..Default::default()
    };
    stubs.points.insert(request).await.map(drop)
}

/// With `restart` the servers are killed too, and know the lost records only from their data directories.
async fn lose(restart: bool) {
    let directory = tempfile::tempdir().unwrap();
    let nats = Nats::start(directory.path(), 1);
    let mut cluster = Cluster { directory, nats };
    let mut servers: Vec<_> = (0..2).map(|number| cluster.start(number)).collect();
    let mut stubs = Stubs::connect(servers[0].uri()).await;
    stubs.create("arm", "R1").await;
    for id in 0..KEPT {
        insert(&mut stubs, id).await.unwrap();
    }
    cluster.nats.kill(0);
    let copy = cluster.directory.path().join("copy");
    Cluster::copy(&cluster.store(), &copy);
    cluster.nats.restart(0);
    for id in KEPT..KEPT + LOST {
        while insert(&mut stubs, id).await.is_err() {
            tokio::task::yield_now().await;
        }
    }
    let mut other = Stubs::connect(servers[1].uri()).await;
    other.latest("arm").await.unwrap();

    cluster.nats.kill(0);
    if restart {
        for server in servers.drain(..) {
            server.stop(Signal::Kill);
        }
    }
    std::fs::remove_dir_all(cluster.store()).unwrap();
    Cluster::copy(&copy, &cluster.store());
    cluster.nats.restart(0);
    if restart {
        servers = (0..2).map(|number| cluster.start(number)).collect();
    }

    let mut stubs = Stubs::connect(servers[0].uri()).await;
    let written = async {
        while insert(&mut stubs, KEPT + LOST).await.is_err() {
            tokio::task::yield_now().await;
        }
    };
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
