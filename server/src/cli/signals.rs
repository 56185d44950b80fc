//! SIGINT and SIGTERM: the first asks the server to stop, the second ends it.

use std::{io, process};

use tokio::sync::oneshot;
use tracing::warn;

/// What a shell reports for a program that a signal ended is this, plus the signal's number.
const SIGNAL_STATUS_BASE: i32 = 128;

/// Watches for signals from now on; the future ends at the first one.
pub(super) fn first() -> io::Result<impl Future<Output = ()>> {
    let mut signals = Signals::listen()?;
    let (sender, receiver) = oneshot::channel();
    tokio::spawn(async move {
        signals.next().await;
        // Nobody listens any more if the server has failed meanwhile.
        let _ = sender.send(());
        let number = signals.next().await;
        warn!("second signal: ending at once");
        process::exit(SIGNAL_STATUS_BASE + number);
    });
    Ok(async move {
        let _ = receiver.await;
    })
}

#[cfg(unix)]
struct Signals {
    interrupt: tokio::signal::unix::Signal,
    terminate: tokio::signal::unix::Signal,
    /// Never waited for: while it is listened for, a file that may not grow is an error of the write, as a full disk is,
    /// and not the end of the server.
    _file_size: tokio::signal::unix::Signal,
}

/// SIGXFSZ, on every system but those on MIPS.
#[cfg(unix)]
const FILE_SIZE: i32 = 25;

#[cfg(unix)]
impl Signals {
    fn listen() -> io::Result<Self> {
        use tokio::signal::unix::{SignalKind, signal};
        Ok(Self {
            interrupt: signal(SignalKind::interrupt())?,
            terminate: signal(SignalKind::terminate())?,
            _file_size: signal(SignalKind::from_raw(FILE_SIZE))?,
        })
    }

    async fn next(&mut self) -> i32 {
        use tokio::signal::unix::SignalKind;
        tokio::select! {
            _ = self.interrupt.recv() => SignalKind::interrupt().as_raw_value(),
            _ = self.terminate.recv() => SignalKind::terminate().as_raw_value(),
        }
    }
}

#[cfg(not(unix))]
struct Signals;

#[cfg(not(unix))]
impl Signals {
    fn listen() -> io::Result<Self> {
        Ok(Self)
    }

    async fn next(&mut self) -> i32 {
        const SIGINT: i32 = 2;
        if tokio::signal::ctrl_c().await.is_err() {
            // Without Ctrl-C the server is stopped from outside.
            std::future::pending::<()>().await;
        }
        SIGINT
    }
}
