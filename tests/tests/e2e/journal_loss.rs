//! NATS loses records that it had acknowledged: its store is set back to an earlier state. Servers that have applied them
//! notice it and publish them again. The environment variable `NATS_SERVER` has the path of the program
//! nats-server.

use std::{ops::Range, path::PathBuf, process::Command, time::Duration};

use tempfile::TempDir;
use tokio::time::timeout;
use wayfold_proto::v1::InsertRequest;
use wayfold_tests::{Content, Process, ServerProcess, Signal, Stubs, insert_request, nats::Nats};

const KEPT: u64 = 50;
const LOST: u64 = 300;
/// NATS comes back, and the servers look at it each second.
pub(crate) const MAX_WAIT: Duration = Duration::from_secs(60);

/// The beginning of what is denied in the configuration of NATS.
const DENIED: &str = "no_auth_user: any\n";

/// Servers of NATS, and servers with a data directory each.
pub(crate) struct Cluster {
    directory: TempDir,
    pub(crate) nats: Nats,
}

impl Cluster {
    /// A cluster without a server of Wayfold.
    pub(crate) fn empty() -> Self {
        Self::with_nats(1)
    }

    /// The same with this many servers of NATS, which have pages for operators.
    pub(crate) fn with_nats(count: usize) -> Self {
        let directory = tempfile::tempdir().unwrap();
        let nats = Nats::start_with(directory.path(), count, "http: \"127.0.0.1:-1\"");
        Self { directory, nats }
    }

    pub(crate) fn start(&self, number: usize) -> ServerProcess {
        self.start_with(number, &[])
    }

    /// Starts a server with these settings too.
    pub(crate) fn start_with(&self, number: usize, settings: &[(&str, &str)]) -> ServerProcess {
        ServerProcess::ready(self.launch(number, settings))
    }

    /// Starts a server, which is not ready yet.
    fn launch(&self, number: usize, settings: &[(&str, &str)]) -> Process {
        let mut command = Command::new(env!("CARGO_BIN_EXE_server-process"));
        command
            .args(["--grpc", "127.0.0.1:0", "--http", "127.0.0.1:0"])
            .env("WAYFOLD_DATA__DIR", self.data(number))
            .envs(self.nats.member_settings())
            .envs(settings.iter().copied());
        Process::spawn(&mut command)
    }

    /// Restarts NATS so that no server can follow the indices of a stream.
    fn hide(&mut self, stream: u8) {
        let consumers = format!("$JS.API.CONSUMER.CREATE.wayfold-log-{stream}");
        self.deny(&[&consumers, &format!("{consumers}.>")]);
    }

    /// Restarts NATS so that it takes nothing on these subjects, and gives no answer there.
    pub(crate) fn deny(&mut self, subjects: &[&str]) {
        let file = self.directory.path().join("nats-0.conf");
        let text = std::fs::read_to_string(&file).unwrap();
        let allowed = text.split(DENIED).next().unwrap();
        let text = match subjects {
            [] => allowed.to_owned(),
            denied => format!(
                "{allowed}{DENIED}authorization {{ users: [ {{ user: any, password: any, permissions: \
                 {{ publish: {{ allow: \">\", deny: {denied:?} }} }} }} ] }}\n"
            ),
        };
        self.nats.kill(0);
        std::fs::write(file, text).unwrap();
        self.nats.restart(0);
    }

    fn data(&self, number: usize) -> PathBuf {
        self.directory.path().join(format!("data-{number}"))
    }

    /// Starts a new generation of the index "arm" from the directory of a server, which is stopped. Returns what the command
    /// tells.
    pub(crate) fn reseed(&self, number: usize) -> String {
        let reseeded = Command::new(env!("CARGO_BIN_EXE_server-process"))
            .args(["reseed", "arm", "--data"])
            .arg(self.data(number))
            .envs(self.nats.member_settings())
            .output()
            .unwrap();
        assert!(reseeded.status.success(), "{reseeded:?}");
        let text = String::from_utf8(reseeded.stdout).unwrap();
        assert!(text.contains("index arm goes on as "), "{text}");
        text
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

    /// Removes the store from the data directory of a server, which is stopped: the server cannot open it.
    pub(crate) fn lose_points(&self, number: usize) {
        std::fs::remove_dir_all(self.data(number).join("store")).unwrap();
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
        ids: vec![id],
        operation_id: format!("insert {id}"),
        ..insert_request("arm", &[id as f64], 1)
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

/// No call notices the loss: the server looks at the end of the stream after half a minute without a message.
#[ignore = "needs nats-server"]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_idle_server_notices_that_nats_has_lost_its_newest_record() {
    const RECORDS: u64 = 3;
    let cluster = Cluster::empty();
    let mut server = cluster.start(0);
    let mut stubs = Stubs::connect(server.uri()).await;
    let arm = stubs.create("arm", "R1").await.revision.unwrap().uid;
    for id in 0..RECORDS {
        insert(&mut stubs, id).await.unwrap();
    }
    assert!(cluster.nats.remove_record(&arm, RECORDS).await);

    server.log_until("the journal had lost its newest records");
    let (_, messages) = cluster.nats.messages(&arm).await;
    let last = messages.last().unwrap().headers.get("Wayfold-Last");
    assert_eq!(last.unwrap().as_str(), RECORDS.to_string());
    server.stop(Signal::Kill);
}

/// The number of the stream of an index.
fn stream(uid: &str) -> u8 {
    u8::from_str_radix(&uid[..2], 16).unwrap() % 4
}

/// The start takes a minute, because one index cannot be followed.
#[ignore = "needs nats-server"]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn records_that_nats_loses_come_back_while_a_server_starts() {
    const LOST: u64 = 3;
    let mut cluster = Cluster::empty();
    let server = cluster.start(0);
    let mut stubs = Stubs::connect(server.uri()).await;
    let created = stubs.create("arm", "R1").await;
    let arm = created.revision.unwrap().uid;
    let (mut hidden, mut number) = (String::new(), 0);
    while hidden.is_empty() {
        let name = format!("leg-{number}");
        let uid = stubs.create(&name, "R1").await.revision.unwrap().uid;
        if stream(&uid) != stream(&arm) {
            hidden = uid;
        } else {
            number += 1;
        }
    }
    for id in 0..KEPT + LOST {
        insert(&mut stubs, id).await.unwrap();
    }
    // Killed, it might not have stored the newest records.
    server.stop(Signal::Terminate);
    let other = cluster.start(1);
    let mut others = Stubs::connect(other.uri()).await;
    let request = insert_request(&format!("leg-{number}"), &[0.5], 1);
    others.insert(request).await;
    other.stop(Signal::Kill);
    for revision in (KEPT + 1..=KEPT + LOST).rev() {
        assert!(cluster.nats.remove_record(&arm, revision).await);
    }
    cluster.hide(stream(&hidden));

    let mut server = cluster.launch(0, &[]);
    let log = server.log_until("the journal had lost its newest records");
    let is_started = |line: &String| line.contains("caught up with the journal");
    assert!(!log.iter().any(is_started), "{log:?}");
    let (_, messages) = cluster.nats.messages(&arm).await;
    let last = messages.last().unwrap().headers.get("Wayfold-Last");
    assert_eq!(last.unwrap().as_str(), (KEPT + LOST).to_string());
    server.stop(Signal::Kill);
}
