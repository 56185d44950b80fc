//! A server of NATS stands still, and its connections stay open. The server that is connected to it goes on at another. The
//! environment variable `NATS_SERVER` has the path of the program nats-server.

use std::process::Command;

use tokio::time::timeout;
use wayfold_tests::{Process, ServerProcess, Signal, Stubs, nats::Nats};

use crate::journal_loss::{MAX_WAIT, insert_until_acknowledged};

const NATS_SERVERS: usize = 3;
const POINTS: u64 = 3;

#[ignore = "needs nats-server"]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn writes_go_on_while_a_server_of_nats_stands_still() {
    let directory = tempfile::tempdir().unwrap();
    let nats = Nats::start(directory.path(), NATS_SERVERS);
    let mut command = Command::new(env!("CARGO_BIN_EXE_server-process"));
    command
        .args(["--grpc", "127.0.0.1:0", "--data"])
        .arg(directory.path().join("data"))
        .envs(nats.member_settings());
    let server = ServerProcess::ready(Process::spawn(&mut command));
    let mut stubs = Stubs::connect(server.uri()).await;
    stubs.create("arm", "R1").await;
    // One of them is the one to which the server is connected.
    for node in 0..NATS_SERVERS {
        nats.signal(node, Signal::Pause);
        let first = node as u64 * POINTS;
        let written = insert_until_acknowledged(&mut stubs, first..first + POINTS);
        let written = timeout(MAX_WAIT, written).await;
        nats.signal(node, Signal::Resume);
        assert!(
            written.is_ok(),
            "nothing is written while {node} stands still"
        );
    }
}
