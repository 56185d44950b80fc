//! A server for the run of one example: this program again, in another role.

use std::{
    env,
    io::{self, BufRead, BufReader},
    process::{Child, ChildStdout, Command, ExitCode, Stdio},
};

use super::error::PlanningError;

/// Set in the process that is the server.
const ROLE: &str = "WAYFOLD_EXAMPLE_ROLE";

/// Serves until the end, if this process was started to do so: the first call of an example's `main`.
pub fn serve_if_told() -> Option<ExitCode> {
    (env::var(ROLE).as_deref() == Ok("server")).then(wayfold_server::main)
}

/// A server in memory on a free port of this machine, killed when it is dropped.
pub struct ServerProcess {
    child: Child,
    uri: String,
    /// Held, or what the server prints later would meet a closed pipe.
    _output: BufReader<ChildStdout>,
}

impl ServerProcess {
    /// Starts one, and returns once it answers.
    pub fn start() -> Result<ServerProcess, PlanningError> {
        let program = env::current_exe().map_err(PlanningError::Server)?;
        let mut child = Command::new(program)
            .env(ROLE, "server")
            .args(["--grpc", "127.0.0.1:0", "--zenoh", "off"])
            .args(["--data", "memory", "--log", "warn"])
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .spawn()
            .map_err(PlanningError::Server)?;
        let mut line = String::new();
        let output = child.stdout.take().map(BufReader::new);
        let mut output = output.ok_or_else(|| silent("it has no output"))?;
        output.read_line(&mut line).map_err(PlanningError::Server)?;
        match line.trim_end().strip_prefix("listening on ") {
            Some(uri) => Ok(ServerProcess {
                uri: uri.to_owned(),
                child,
                _output: output,
            }),
            None => {
                // It has ended already, or is of no use.
                let _ = child.kill();
                let _ = child.wait();
                Err(silent("it did not say where it listens"))
            }
        }
    }

    /// Where it listens.
    pub fn uri(&self) -> &str {
        &self.uri
    }
}

fn silent(problem: &str) -> PlanningError {
    PlanningError::Server(io::Error::other(problem.to_owned()))
}

impl Drop for ServerProcess {
    fn drop(&mut self) {
        // Either fails only if it has ended already.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
