//! A planner whose machine sleeps: its process stands still while others write on, and its clock with it.

use wayfold::{Client, Space};
use wayfold_tests::{Process, Signal, States, server};

use crate::metrics::figures;

/// The records of a second connection that the log forgets meanwhile.
const OTHERS: usize = 500;

/// The server gives up the connection of the sleeper, and its log forgets what came meanwhile. Once awake, the planner has
/// all points of others, and they have its own, each once.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_planner_that_slept_goes_on() {
    let mut server = server!("--http", "127.0.0.1:0";
        ("WAYFOLD_INDEX__WINDOW_BYTES", "2000"),
        ("WAYFOLD_GRPC__KEEPALIVE_INTERVAL_MS", "500"),
        ("WAYFOLD_GRPC__KEEPALIVE_TIMEOUT_MS", "500"));
    let pages = server.pages();
    let client = Client::connect(server.uri()).await.unwrap();
    let space: Space = super::SPACE.parse().unwrap();
    let index = client.create_index("arm", &space).await.unwrap();
    let mut sleeper = Process::start(env!("CARGO_BIN_EXE_copy-process"), &[server.uri(), "arm"]);
    assert_eq!(sleeper.line().as_deref(), Some("ready"));
    sleeper.say("5");
    assert_eq!(sleeper.line().as_deref(), Some("5"));
    let subscribers = || {
        figures(&pages)
            .get("wayfold_index_subscribers{index=\"arm\"}")
            .copied()
    };
    while subscribers() != Some(1.0) {}

    sleeper.signal(Signal::Pause);
    let mut states = States::new(space.clone(), 6);
    for _ in 0..OTHERS {
        index
            .insert(states.row().chunks(space.coordinates()))
            .await
            .unwrap();
    }
    while subscribers() != Some(0.0) {}
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
