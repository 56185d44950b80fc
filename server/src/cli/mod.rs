//! The command line of `wayfold-server`: settings, logging, runtime, serving, draining, exit status.

mod files;
mod flags;
mod repair;
mod reseed;
mod signals;
mod welcome;

use std::{
    error::Error,
    fmt::Display,
    io::{self, Write},
    path::Path,
    process::ExitCode,
    time::Duration,
};

use clap::Parser;
use tokio::{net::TcpListener, runtime};

use crate::{
    config::{Config, DEFAULTS},
    faces::Addresses,
    huge_pages, observe,
    run::{self, ServerError},
    snapshots::SnapshotsError,
    zenoh,
};
use flags::{Command, Flags};

/// Exit status: the command line or the settings are wrong.
const USAGE_STATUS: u8 = 2;
/// Exit status: the server could not start or cut calls when it stopped, or standard output could not be written.
const FAILURE_STATUS: u8 = 1;

/// Runs the server that the command line describes until it has stopped, repairs its store, or reseeds an index.
pub fn main() -> ExitCode {
    let flags = Flags::parse();
    if flags.print_config {
        return print(DEFAULTS, 0);
    }
    let settings = flags.settings().map_err(Box::<dyn Error>::from);
    let config = match settings.and_then(|config| {
        observe::start(&config.log.filter, config.log.format)?;
        Ok(config)
    }) {
        Ok(config) => config,
        Err(error) => return fail(error, USAGE_STATUS),
    };
    huge_pages::use_small_pages();
    // Data and snapshots hold the points of all indices: only the user of the server reads the files that it makes.
    #[cfg(target_os = "linux")]
    rustix::process::umask(rustix::fs::Mode::RWXG | rustix::fs::Mode::RWXO);
    files::raise_limit();
    match flags.command {
        Some(Command::Repair { dry_run }) => return repair::run(&config, dry_run),
        Some(Command::Reseed { index, uid }) => {
            return reseed::run(&config, &index, uid.as_deref());
        }
        None => {}
    }
    match serve(config) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            let status = match error.downcast_ref() {
                Some(ServerError::Snapshots(SnapshotsError::InData { .. })) => USAGE_STATUS,
                _ => FAILURE_STATUS,
            };
            fail(error, status)
        }
    }
}

/// Ends with `status` once standard output has the text. A reader that closed it early, such as `head`, has seen enough.
fn print(text: &str, status: u8) -> ExitCode {
    let mut out = io::stdout().lock();
    let written = out.write_all(text.as_bytes()).and_then(|()| out.flush());
    match written {
        Err(error) if error.kind() != io::ErrorKind::BrokenPipe => {
            let error = format!("cannot write to standard output: {error}");
            fail(error, FAILURE_STATUS)
        }
        _ => ExitCode::from(status),
    }
}

fn fail(error: impl Display, status: u8) -> ExitCode {
    // A closed standard error has no reader to report to.
    let _ = writeln!(io::stderr(), "wayfold-server: {error}");
    ExitCode::from(status)
}

/// The most threads for the store, merges and other blocking work: tokio's default.
const BLOCKING_THREADS: usize = 512;

/// A thread of these that has no work ends after this time, so that the memory which it holds is given back soon.
const THREAD_KEEP_ALIVE: Duration = Duration::from_secs(1);

fn serve(config: Config) -> Result<(), Box<dyn Error>> {
    files::check_limit(&config);
    let mut threads = runtime::Builder::new_multi_thread();
    if config.runtime.workers > 0 {
        threads.worker_threads(config.runtime.workers);
    }
    let waiting = zenoh::max_senders(&config.zenoh);
    threads.max_blocking_threads(BLOCKING_THREADS.saturating_add(waiting));
    threads.thread_keep_alive(THREAD_KEEP_ALIVE);
    let runtime = threads.enable_all().build()?;
    let ended = runtime.block_on(listen_and_serve(config));
    // Tasks that still run belong to calls that were cut.
    runtime.shutdown_background();
    ended
}

async fn listen_and_serve(config: Config) -> Result<(), Box<dyn Error>> {
    // Signals are watched before the listener is bound, so that an early one is not lost.
    let shutdown = signals::first()?;
    let listen = config.grpc.listen.clone();
    let listener = TcpListener::bind(&listen)
        .await
        .map_err(|error| cannot_listen(&listen, &error))?;
    let directory = config.data.directory().map(Path::to_owned);
    let ready = move |addresses: &Addresses| welcome::print(addresses, directory.as_deref());
    run::serve(config, listener, shutdown, ready)
        .await
        .map_err(|error: ServerError| error.into())
}

fn cannot_listen(listen: &str, error: &io::Error) -> String {
    let advice = match error.kind() {
        io::ErrorKind::AddrInUse => {
            "another program listens there, perhaps another wayfold-server: stop it, or choose another port \
             (--grpc 127.0.0.1:0 takes any free port)"
        }
        io::ErrorKind::PermissionDenied => {
            "ports below 1024 usually need extra rights: choose a higher port with --grpc"
        }
        io::ErrorKind::AddrNotAvailable => {
            "this machine does not have that address: 127.0.0.1 serves this machine only, 0.0.0.0 every network \
             interface"
        }
        _ => "give an address as HOST:PORT with --grpc, such as 127.0.0.1:50051",
    };
    format!("cannot listen on {listen}: {error}\n  {advice}")
}
