//! A server for the run of one planner: another instance of this program.

use std::{
    env,
    io::{self, BufRead, BufReader},
    process::{self, Child, ChildStdout, Command, ExitCode, Stdio},
    thread,
};

use tempfile::TempDir;

use super::error::PlanningError;

/// Set in the process that is the server.
const ROLE: &str = "WAYFOLD_PLANNER_ROLE";

/// If this process was started as a server, serves until its end or until its parent is gone. It is the first call of a
/// planner's `main`.
pub fn serve_if_requested() -> Option<ExitCode> {
    if env::var(ROLE).as_deref() != Ok("server") {
        return None;
    }
    thread::spawn(|| {
        // Nothing is written to this stream: it ends when the parent process, which holds the other end, is gone for
        // any reason.
        let _ = io::copy(&mut io::stdin().lock(), &mut io::sink());
        process::exit(0);
    });
    Some(wayfold_server::main())
}

/// A server on a free port of this machine. It is killed when it is dropped, and ends by itself if this process is
/// killed.
pub struct ServerProcess {
    child: Child,
    uri: String,
    /// Kept open, because later output of the server would meet a closed pipe.
    _output: Option<BufReader<ChildStdout>>,
    /// Its data directory, removed when it is dropped.
    data: TempDir,
}

impl ServerProcess {
    /// Starts a server with its indices on disk for the life of this value, and returns once it answers.
    pub fn start() -> Result<ServerProcess, PlanningError> {
        let data = TempDir::new().map_err(PlanningError::Server)?;
        let mut started = ServerProcess {
            child: spawn("127.0.0.1:0", &data)?,
            uri: String::new(),
            _output: None,
            data,
        };
        started.listened()?;
        Ok(started)
    }

    /// Waits until it prints its address.
    fn listened(&mut self) -> Result<(), PlanningError> {
        let mut line = String::new();
        let output = self.child.stdout.take().map(BufReader::new);
        let mut output = output.ok_or_else(|| silent("it has no output"))?;
        output.read_line(&mut line).map_err(PlanningError::Server)?;
        let uri = line.trim_end().strip_prefix("listening on ");
        let uri = uri.ok_or_else(|| silent("it did not say where it listens"))?;
        self.uri = uri.to_owned();
        self._output = Some(output);
        Ok(())
    }

    /// Its address.
    pub fn uri(&self) -> &str {
        &self.uri
    }

    /// Kills it, and returns once it is gone.
    pub fn kill(&mut self) -> Result<(), PlanningError> {
        let killed = self.child.kill().and_then(|()| self.child.wait());
        killed.map(drop).map_err(PlanningError::Server)
    }

    /// Restarts it after its end, with the same data and the same address; returns once it answers.
    pub fn start_again(&mut self) -> Result<(), PlanningError> {
        let address = self.uri.trim_start_matches("http://");
        self.child = spawn(address, &self.data)?;
        self.listened()
    }
}

fn spawn(address: &str, data: &TempDir) -> Result<Child, PlanningError> {
    let program = env::current_exe().map_err(PlanningError::Server)?;
    let child = Command::new(program)
        .env(ROLE, "server")
        .args([
            "--grpc", address, "--zenoh", "off", "--http", "off", "--log", "warn",
        ])
        .arg("--data")
        .arg(data.path())
        // The child's handle holds it, and the system closes it if this process is killed.
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn();
    child.map_err(PlanningError::Server)
}

fn silent(problem: &str) -> PlanningError {
    PlanningError::Server(io::Error::other(problem.to_owned()))
}

impl Drop for ServerProcess {
    fn drop(&mut self) {
        // Both calls fail only if it has already ended.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
