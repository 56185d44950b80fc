//! SIGINT and SIGTERM: the first stops the server, the second ends the process at once.

use std::{io, process};

use tokio::sync::oneshot;
use tracing::warn;

/// A shell reports a process that a signal ended by this plus the signal's number.
const SIGNAL_STATUS_BASE: i32 = 128;

/// Watches for signals from now on. The future resolves at the first one.
pub(super) fn first() -> io::Result<impl Future<Output = ()>> {
    let mut signals = Signals::listen()?;
    let (sender, receiver) = oneshot::channel();
    tokio::spawn(async move {
        signals.next().await;
        // The receiver is gone if the server has failed.
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
    /// A handler for SIGXFSZ that nothing reads: with it, a write beyond the file size limit fails as on a full disk
    /// instead of ending the process.
    _file_size: tokio::signal::unix::Signal,
}

/// SIGXFSZ has this number on every architecture but MIPS.
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
            // Without a Ctrl-C handler only an outside kill stops the server.
            std::future::pending::<()>().await;
        }
        SIGINT
    }
}
