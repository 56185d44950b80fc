//! The command line as a process.

use std::{
    io::{PipeWriter, Write},
    process::{Child, Command, Stdio},
};

use serde_json::{Value, json};

use crate::server::Server;

/// A run that ended.
#[derive(Debug)]
pub(crate) struct Run {
    pub(crate) status: Option<i32>,
    pub(crate) stdout: String,
    pub(crate) stderr: String,
}

impl Run {
    /// The values on standard output, one a line, of a run without a complaint. A pipe has no progress bar either.
    pub(crate) fn lines(&self) -> Vec<Value> {
        let lines = self.lines_and(0);
        assert_eq!(self.stderr, "");
        lines
    }

    /// The values on standard output, one a line, of a run that ended with this status.
    pub(crate) fn lines_and(&self, status: i32) -> Vec<Value> {
        assert_eq!(self.status, Some(status), "{}", self.stderr);
        let lines = self.stdout.lines();
        lines
            .map(|line| serde_json::from_str(line).expect(line))
            .collect()
    }

    /// The only value on standard output.
    pub(crate) fn line(&self) -> Value {
        let mut lines = self.lines();
        assert_eq!(lines.len(), 1, "{}", self.stdout);
        lines.remove(0)
    }

    /// The error in JSON of a run without output.
    pub(crate) fn json_error(&self, status: i32) -> Value {
        let error = self.error(status);
        assert_eq!(error.matches('\n').count(), 1, "{error}");
        let mut error: Value = serde_json::from_str(error).expect(error);
        assert_eq!(error.as_object().unwrap().len(), 1, "{error}");
        error["error"].take()
    }

    /// The message on standard error of a run without output.
    pub(crate) fn error(&self, status: i32) -> &str {
        assert_eq!(self.status, Some(status), "{}{}", self.stdout, self.stderr);
        assert_eq!(self.stdout, "");
        &self.stderr
    }
}

const PROGRAM: &str = env!("CARGO_BIN_EXE_wayfold");

pub(crate) fn command(server: &str, args: &[&str]) -> Command {
    program(PROGRAM, server, args)
}

fn program(program: &str, server: &str, args: &[&str]) -> Command {
    let mut command = Command::new(program);
    command.args(args).env("WAYFOLD_SERVER", server);
    command
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped());
    command
}

/// A pipe whose reader has left.
pub(crate) fn closed_pipe() -> PipeWriter {
    let (_, write) = std::io::pipe().unwrap();
    write
}

/// Sends `INT` or another signal.
pub(crate) fn send(signal: &str, child: &Child) {
    // The shell's own `kill`: the program is missing on small systems.
    let kill = format!("kill -{signal} {}", child.id());
    let sent = Command::new("sh").args(["-c", &kill]).status();
    assert!(sent.unwrap().success());
}

fn ended(mut child: Child, input: &str) -> Run {
    let mut stdin = child.stdin.take().unwrap();
    let input = input.to_owned();
    // On a thread of its own, as the process may print before it has read all.
    let writer = std::thread::spawn(move || {
        // A process that fails early reads no further.
        let _ = stdin.write_all(input.as_bytes());
    });
    let output = child.wait_with_output().unwrap();
    writer.join().unwrap();
    Run {
        status: output.status.code(),
        stdout: String::from_utf8(output.stdout).unwrap(),
        stderr: String::from_utf8(output.stderr).unwrap(),
    }
}

impl Server {
    /// `wayfold ARGS`.
    pub(crate) fn run(&self, args: &[&str]) -> Run {
        self.run_with(args, "")
    }

    /// A revision of an index in JSON.
    pub(crate) fn revision(&self, index: &str, number: u64) -> Value {
        let info = self.json(&["info", index]).line();
        json!({"uid": info["revision"]["uid"], "number": number})
    }

    /// `wayfold ARGS --output json`.
    pub(crate) fn json(&self, args: &[&str]) -> Run {
        self.json_with(args, "")
    }

    /// `wayfold ARGS` with something on standard input.
    pub(crate) fn run_with(&self, args: &[&str], input: &str) -> Run {
        ended(command(&self.uri, args).spawn().unwrap(), input)
    }

    /// `wayfold ARGS --output json` with something on standard input.
    pub(crate) fn json_with(&self, args: &[&str], input: &str) -> Run {
        self.run_with(&[args, &["--output", "json"]].concat(), input)
    }
}

/// A script of a shell, whose `$0` is `wayfold`.
pub(crate) fn shell(server: &str, script: &str) -> Run {
    let mut shell = program("sh", server, &["-c", script, PROGRAM]);
    ended(shell.spawn().unwrap(), "")
}

/// `wayfold ARGS` where no server is.
pub(crate) fn run_alone(args: &[&str]) -> Run {
    ended(command("http://127.0.0.1:0", args).spawn().unwrap(), "")
}
