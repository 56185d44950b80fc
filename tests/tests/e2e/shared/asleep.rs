//! A planner whose machine sleeps: its process stands still while others write on, and its clock with it.

use std::process::Command;

use wayfold::{Client, Space};
use wayfold_tests::{Process, ServerProcess, Signal, States, page};

/// The records of a second connection that the log forgets meanwhile.
const OTHERS: usize = 500;

/// The number of subscribers of the index, as `/metrics` tells it.
fn subscribers(address: &str) -> String {
    let (status, text) = page(address, "/metrics", "");
    assert_eq!(status, 200);
    let line = text
        .lines()
        .find_map(|line| line.strip_prefix("wayfold_index_subscribers{index=\"arm\"} "));
    line.unwrap_or_default().to_owned()
}

/// The server gives up the connection of the sleeper, and its log forgets what came meanwhile. Once awake, the planner has
/// all points of others, and they have its own, each once.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_planner_that_slept_goes_on() {
    let mut command = Command::new(env!("CARGO_BIN_EXE_server-process"));
    command
        .args([
            "--grpc",
            "127.0.0.1:0",
            "--http",
            "127.0.0.1:0",
            "--data",
            "memory",
        ])
        .env("WAYFOLD_INDEX__WINDOW_BYTES", "2000")
        .env("WAYFOLD_GRPC__KEEPALIVE_INTERVAL_MS", "500")
        .env("WAYFOLD_GRPC__KEEPALIVE_TIMEOUT_MS", "500");
    let mut server = ServerProcess::ready(Process::spawn(&mut command));
    let pages = server.pages();
    let client = Client::connect(server.uri()).await.unwrap();
    let space: Space = super::SPACE.parse().unwrap();
    let index = client.create_index("arm", &space).await.unwrap();
    let mut sleeper = Process::start(env!("CARGO_BIN_EXE_copy-process"), &[server.uri(), "arm"]);
    assert_eq!(sleeper.line().as_deref(), Some("ready"));
    sleeper.say("5");
    assert_eq!(sleeper.line().as_deref(), Some("5"));
    while subscribers(&pages) != "1" {}

    sleeper.signal(Signal::Pause);
    let mut states = States::new(space.clone(), 6);
    for _ in 0..OTHERS {
        index
            .insert(states.row().chunks(space.coordinates()))
            .await
            .unwrap();
    }
    while subscribers(&pages) != "0" {}
    // Its first writes are made before it knows that it was left.
    sleeper.say("7");
    sleeper.signal(Signal::Resume);
    let expected = OTHERS + 12;
    assert_eq!(sleeper.line(), Some(expected.to_string()));
    assert_eq!(index.info().await.unwrap().point_count, expected as u64);
    sleeper.stop(Signal::Kill);
    let finished = server.stop(Signal::Terminate);
    assert_eq!(finished.status.code(), Some(0), "{}", finished.stderr);
}
