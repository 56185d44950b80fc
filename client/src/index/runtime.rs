//! The thread on which this process talks to servers.

use std::sync::{Arc, OnceLock, mpsc};

use tokio::{
    runtime::{Builder, Runtime},
    task::JoinHandle,
};

use super::{origin::Origin, wait::receive};
use crate::{Error, net::in_same_trace};

struct Owned {
    runtime: Runtime,
    /// The process that started it.
    origin: Origin,
}

static RUNTIME: OnceLock<Owned> = OnceLock::new();

/// The runtime of all shared and remote indices. If it cannot start, the next call tries again.
fn runtime() -> Result<&'static Runtime, Error> {
    let owned = loop {
        if let Some(owned) = RUNTIME.get() {
            break owned;
        }
        if let Err(second) = RUNTIME.set(start()?) {
            // Another thread was first. A drop would wait, which panics in another runtime's task.
            second.runtime.shutdown_background();
        }
    };
    owned.origin.check()?;
    Ok(&owned.runtime)
}

fn start() -> Result<Owned, Error> {
    let started = Builder::new_multi_thread()
        .worker_threads(1)
        .thread_name("wayfold-io")
        .enable_all()
        .build();
    let runtime = started.map_err(|source| Error::Thread {
        source: Arc::new(source),
    })?;
    Ok(Owned {
        runtime,
        origin: Origin::current(),
    })
}

/// Runs a task on the runtime, in the trace of the caller.
pub(super) fn spawn<T: Send + 'static>(
    task: impl Future<Output = T> + Send + 'static,
) -> Result<JoinHandle<T>, Error> {
    Ok(runtime()?.spawn(in_same_trace(task)))
}

/// Fails in a process that was forked from the one with the runtime: nothing that a task sends arrives there.
pub(super) fn check_process() -> Result<(), Error> {
    runtime().map(drop)
}

/// Runs a call on the runtime, and waits for it. It may be called inside another runtime's task, which it blocks.
pub(super) fn wait_for<T: Send + 'static>(
    call: impl Future<Output = Result<T, Error>> + Send + 'static,
) -> Result<T, Error> {
    let (send, answer) = mpsc::sync_channel(1);
    spawn(async move {
        // The caller waits as long as the call runs, unless it is interrupted.
        let _ = send.send(call.await);
    })?;
    let lost = || Error::Thread {
        source: Arc::new(std::io::Error::other("a call ended without an answer")),
    };
    receive(&answer)?.ok_or_else(lost)?
}
