//! Support for the programs that measure. Each such program also runs, in separate processes, as the server and the
//! echo that it measures, so all contestants are built alike.

use std::{
    env, fs,
    path::PathBuf,
    process::{Command, ExitCode},
};

use clap::Parser;
use serde_json::{Value, json};
use zenoh::{Config, Session};

use crate::{Process, ServerProcess, echo};

/// The environment variable with the role of a started process; unset in the measuring process.
pub const ROLE: &str = "MEASURING_ROLE";

/// The role of the server.
pub const SERVER: &str = "server";

/// The role of this process, if the measuring process has started it.
pub fn role() -> Option<String> {
    env::var(ROLE).ok()
}

/// Runs such a program. `measure` takes its arguments and returns the figures and their file.
///
/// # Panics
/// If the process cannot start its threads.
pub fn main<A, F>(measure: impl FnOnce(A) -> F) -> ExitCode
where
    A: Parser,
    F: Future<Output = (Value, Option<PathBuf>)>,
{
    // All contestants have the server's allocator and its pages.
    wayfold_server::use_small_pages();
    match role().as_deref() {
        Some(SERVER) => return wayfold_server::main(),
        Some("echo") => return echo::main(),
        _ => {}
    }
    let arguments = A::parse();
    let runtime = tokio::runtime::Runtime::new().expect("a runtime");
    let (figures, file) = runtime.block_on(measure(arguments));
    let Some(path) = file else {
        return ExitCode::SUCCESS;
    };
    match fs::write(&path, format!("{figures:#}\n")) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {}: {error}", path.display());
            ExitCode::FAILURE
        }
    }
}

/// Starts this program as a server; `data` is its data directory, or "memory".
///
/// # Panics
/// If it does not come up.
pub fn server(data: &str) -> ServerProcess {
    start(SERVER, &["--grpc", "127.0.0.1:0", "--data", data])
}

/// Starts this program as a server that also speaks Zenoh, at [`ServerProcess::zenoh`].
///
/// # Panics
/// If it does not come up.
pub fn server_over_zenoh(data: &str) -> ServerProcess {
    let listen = ["--grpc", "127.0.0.1:0", "--zenoh", "tcp/127.0.0.1:0"];
    start(SERVER, &[&listen[..], &["--data", data]].concat())
}

/// A Zenoh session whose only peer is at the locator.
///
/// # Panics
/// If the locator has no peer.
pub async fn connect(locator: &str) -> Session {
    let config = json!({
        "mode": "client",
        "connect": { "endpoints": [locator] },
        "scouting": { "multicast": { "enabled": false }, "gossip": { "enabled": false } },
    });
    let config = Config::from_json5(&config.to_string()).expect("a configuration");
    zenoh::open(config).await.expect("a session")
}

/// Starts this program as an echo.
///
/// # Panics
/// If it does not come up.
pub fn echo() -> ServerProcess {
    start("echo", &[])
}

/// Starts this program in a role, and waits until it prints its address.
///
/// # Panics
/// If it does not come up.
pub fn start(role: &str, arguments: &[&str]) -> ServerProcess {
    ServerProcess::ready(spawn(role, arguments))
}

/// Starts this program in a role.
///
/// # Panics
/// If it cannot be started.
pub fn spawn(role: &str, arguments: &[&str]) -> Process {
    Process::spawn(command(role).args(arguments))
}

/// The command that starts this program in a role.
///
/// # Panics
/// If the system does not name this program.
pub fn command(role: &str) -> Command {
    let program = env::current_exe().expect("this program");
    let mut command = Command::new(program);
    command.env(ROLE, role);
    command
}
