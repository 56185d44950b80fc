//! The thread on which this process talks to servers.

use std::sync::{Arc, OnceLock, mpsc};

use tokio::{
    runtime::{Builder, Runtime},
    task::JoinHandle,
};

use super::origin::Origin;
use crate::{Error, net::in_same_trace};

struct Owned {
    runtime: Runtime,
    /// The process that started it.
    origin: Origin,
}

static RUNTIME: OnceLock<Result<Owned, Arc<std::io::Error>>> = OnceLock::new();

/// The runtime of all shared and remote indices.
fn runtime() -> Result<&'static Runtime, Error> {
    let start = || {
        let runtime = Builder::new_multi_thread()
            .worker_threads(1)
            .thread_name("wayfold-io")
            .enable_all()
            .build()
            .map_err(Arc::new)?;
        Ok(Owned {
            runtime,
            origin: Origin::current(),
        })
    };
    match RUNTIME.get_or_init(start) {
        Ok(owned) if owned.origin.is_current() => Ok(&owned.runtime),
        Ok(_) => Err(Error::Forked),
        Err(source) => Err(Error::Thread {
            source: Arc::clone(source),
        }),
    }
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
    let (send, receive) = mpsc::sync_channel(1);
    spawn(async move {
        // The caller waits as long as the call runs.
        let _ = send.send(call.await);
    })?;
    let lost = |_| Error::Thread {
        source: Arc::new(std::io::Error::other("a call ended without an answer")),
    };
    receive.recv().map_err(lost)?
}
