//! A server does not start with a NATS that would lose or refuse records.

use std::{process::Command, time::Duration};

use async_nats::jetstream::{self, Context, stream::Config};
use wayfold_tests::{
    Process, ServerProcess,
    nats::{Nats, member_settings},
};

/// Starts a server in memory that is a member of a cluster.
pub(crate) fn start(nats: &Nats) -> Process {
    let mut command = Command::new(env!("CARGO_BIN_EXE_server-process"));
    command
        .args(["--grpc", "127.0.0.1:0", "--data", "memory"])
        .envs(member_settings(&nats.urls(), 1));
    Process::spawn(&mut command)
}

fn assert_refused(nats: &Nats, error: &str) {
    let ended = start(nats).finish();
    assert_eq!(ended.status.code(), Some(1), "{}", ended.stderr);
    assert!(ended.stderr.contains(error), "{error}: {}", ended.stderr);
}

/// Edits a stream as an operator would, and returns what it was.
async fn edit(context: &Context, stream: &str, edit: impl FnOnce(&mut Config)) -> Config {
    let found = context.get_stream(stream).await.unwrap();
    let before = found.cached_info().config.clone();
    let mut edited = before.clone();
    edit(&mut edited);
    context.update_stream(&edited).await.unwrap();
    before
}

#[ignore = "needs nats-server"]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_server_refuses_a_nats_that_would_lose_or_refuse_records() {
    let directory = tempfile::tempdir().unwrap();
    let nats = Nats::start(directory.path(), 1);
    drop(ServerProcess::ready(start(&nats)));
    let context = jetstream::new(async_nats::connect(nats.urls()).await.unwrap());
    let hour = |config: &mut Config| config.max_age = Duration::from_secs(3600);
    for stream in ["wayfold-log-2", "KV_wayfold-catalogue"] {
        let before = edit(&context, stream, hour).await;
        assert_refused(&nats, &format!("{stream} has max_age: 3600s; undo that"));
        context.update_stream(&before).await.unwrap();
    }
    // A limit of the space is no loss: NATS refuses what exceeds it.
    edit(&context, "wayfold-log-2", |config| {
        config.max_bytes = 1 << 30
    })
    .await;
    drop(ServerProcess::ready(start(&nats)));

    let directory = tempfile::tempdir().unwrap();
    let nats = Nats::start_with(directory.path(), 1, "max_payload: 1024");
    assert_refused(&nats, "up to 1024 bytes: raise its max_payload to 65536");
}
