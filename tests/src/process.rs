//! Child processes: the server under test, and its clients.

use std::{
    io::{BufRead, BufReader, Read, Write},
    path::Path,
    process::{Child, Command, ExitStatus, Stdio},
    sync::mpsc::{self, Receiver},
    thread,
    time::Duration,
};

/// The maximum time that a test waits for the next line or the end of a process.
const MAX_WAIT: Duration = Duration::from_secs(120);

/// The signal to send to a process.
#[derive(Clone, Copy, Debug)]
pub enum Signal {
    /// SIGTERM, which a supervisor sends.
    Terminate,
    /// SIGINT, which Ctrl-C sends.
    Interrupt,
    /// SIGKILL: the process ends at once.
    Kill,
    /// SIGSTOP: the process stands still, and its connections stay open.
    Pause,
    /// SIGCONT: the process goes on.
    Resume,
}

/// The end of a process.
#[derive(Debug)]
pub struct ProcessOutput {
    /// Its exit status.
    pub status: ExitStatus,
    /// The lines of its standard output that were not read before.
    pub stdout: Vec<String>,
    /// Its whole standard error.
    pub stderr: String,
}

/// A child process whose lines are read as they come. It is killed when it is dropped, and its standard error is shown
/// if the test failed.
#[derive(Debug)]
pub struct Process {
    child: Child,
    lines: Receiver<String>,
    log: Receiver<String>,
    /// The part of the log that was already received.
    logged: String,
}

impl Process {
    /// Starts a program.
    ///
    /// # Panics
    /// If it cannot be started.
    pub fn start(program: impl AsRef<Path>, arguments: &[&str]) -> Self {
        Self::spawn(Command::new(program.as_ref()).args(arguments))
    }

    /// Starts a command. A server speaks Zenoh, and has pages for operators, only if a flag enables it: the usual
    /// ports may be another's.
    ///
    /// # Panics
    /// If it cannot be started.
    pub fn spawn(command: &mut Command) -> Self {
        let mut child = command
            .env("WAYFOLD_ZENOH__LISTEN", "off")
            .env("WAYFOLD_HTTP__LISTEN", "off")
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .expect("the program starts");
        let lines = read_lines(child.stdout.take().expect("a pipe"));
        let log = read_lines(child.stderr.take().expect("a pipe"));
        Self {
            child,
            lines,
            log,
            logged: String::new(),
        }
    }

    /// The process's id.
    pub fn id(&self) -> u32 {
        self.child.id()
    }

    /// The next line of its standard output; none when it has closed it.
    ///
    /// # Panics
    /// If it says nothing for two minutes.
    pub fn line(&mut self) -> Option<String> {
        next(&self.lines)
    }

    /// The next line of its standard error; none when it has closed it.
    ///
    /// # Panics
    /// If it says nothing for two minutes.
    pub fn log_line(&mut self) -> Option<String> {
        let line = next(&self.log)?;
        self.logged += &line;
        self.logged.push('\n');
        Some(line)
    }

    /// Sends it a signal and waits for its end.
    ///
    /// # Panics
    /// Panics where [`Process::signal`] and [`Process::finish`] do.
    pub fn stop(mut self, signal: Signal) -> ProcessOutput {
        match signal {
            // The kill is immediate: it starts no other program.
            Signal::Kill => self.child.kill().expect("a child of this process"),
            signal => self.signal(signal),
        }
        self.finish()
    }

    /// Its standard error up to and including the next line that contains `part`.
    ///
    /// # Panics
    /// Panics where [`Process::log_line`] does, and if the process ends before.
    pub fn log_until(&mut self, part: &str) -> Vec<String> {
        let mut lines = Vec::new();
        while let Some(line) = self.log_line() {
            let found = line.contains(part);
            lines.push(line);
            if found {
                return lines;
            }
        }
        panic!("the process has ended and never said \"{part}\"");
    }

    /// Kills it once it has written `lines` lines to standard error.
    ///
    /// # Panics
    /// Panics where [`Process::log_line`] and [`Process::finish`] do.
    pub fn kill_at_line(mut self, lines: u32) {
        for _ in 0..lines {
            self.log_line();
        }
        self.stop(Signal::Kill);
    }

    /// Writes a line to its standard input.
    ///
    /// # Panics
    /// If it has closed it.
    pub fn say(&mut self, line: &str) {
        let stdin = self.child.stdin.as_mut().expect("a pipe");
        writeln!(stdin, "{line}").expect("the process reads");
    }

    /// Sends a signal.
    ///
    /// # Panics
    /// If it cannot be sent.
    pub fn signal(&self, signal: Signal) {
        use rustix::process::{Pid, Signal as Number, WaitId, WaitIdOptions, kill_process, waitid};
        let number = match signal {
            Signal::Terminate => Number::TERM,
            Signal::Interrupt => Number::INT,
            Signal::Kill => Number::KILL,
            Signal::Pause => Number::STOP,
            Signal::Resume => Number::CONT,
        };
        let id = Pid::from_child(&self.child);
        kill_process(id, number).expect("the process gets the signal");
        if let Signal::Pause = signal {
            // The threads of a process run on for milliseconds after the signal if the machine is loaded.
            let is_over = WaitIdOptions::STOPPED | WaitIdOptions::EXITED;
            waitid(WaitId::Pid(id), is_over | WaitIdOptions::NOWAIT).expect("the process stops");
        }
    }

    /// Closes its standard input and waits for its end.
    ///
    /// # Panics
    /// If it says nothing for two minutes and lives on.
    pub fn finish(mut self) -> ProcessOutput {
        drop(self.child.stdin.take());
        let mut stdout = Vec::new();
        while let Some(line) = self.line() {
            stdout.push(line);
        }
        let status = self.child.wait().expect("a child of this process");
        ProcessOutput {
            status,
            stdout,
            stderr: self.log(),
        }
    }

    /// Its whole standard error, once it has ended.
    fn log(&mut self) -> String {
        while self.log_line().is_some() {}
        std::mem::take(&mut self.logged)
    }
}

/// The lines of a stream, read as they come. The sender is dropped at the end of the stream, which signals the end of
/// the process.
fn read_lines(stream: impl Read + Send + 'static) -> Receiver<String> {
    let (sender, lines) = mpsc::channel();
    thread::spawn(move || {
        for line in BufReader::new(stream).lines().map_while(Result::ok) {
            if sender.send(line).is_err() {
                break;
            }
        }
    });
    lines
}

fn next(lines: &Receiver<String>) -> Option<String> {
    match lines.recv_timeout(MAX_WAIT) {
        Ok(line) => Some(line),
        Err(mpsc::RecvTimeoutError::Disconnected) => None,
        Err(mpsc::RecvTimeoutError::Timeout) => panic!("a process says nothing and lives on"),
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        // Both calls fail only if the process has already ended.
        let _ = self.child.kill();
        let _ = self.child.wait();
        if thread::panicking() {
            eprintln!("process {} wrote:\n{}", self.id(), self.log());
        }
    }
}

/// A server under test, on its own port of the loopback interface.
#[derive(Debug)]
pub struct ServerProcess {
    process: Process,
    uri: String,
}

impl ServerProcess {
    /// Starts the server, in memory unless the arguments set a data directory, and waits until it prints its address.
    /// [`server!`](crate::server) passes the program.
    ///
    /// # Panics
    /// If it does not come up.
    pub fn start(program: impl AsRef<Path>, arguments: &[&str]) -> Self {
        Self::start_with(program, arguments, &[])
    }

    /// Like [`ServerProcess::start`], with settings by environment variables.
    ///
    /// # Panics
    /// If it does not come up.
    pub fn start_with(
        program: impl AsRef<Path>,
        arguments: &[&str],
        settings: &[(&str, &str)],
    ) -> Self {
        let mut command = Command::new(program.as_ref());
        command
            .args(["--grpc", "127.0.0.1:0"])
            .env("WAYFOLD_DATA__DIR", "memory")
            .args(arguments)
            .envs(settings.iter().copied());
        Self::ready(Process::spawn(&mut command))
    }

    /// Waits until a started server prints its address.
    ///
    /// # Panics
    /// If it does not come up.
    pub fn ready(mut process: Process) -> Self {
        match process.line() {
            Some(line) => Self::listening(process, &line),
            None => panic!("the server did not say that it listens"),
        }
    }

    /// The server whose first line was `line`.
    ///
    /// # Panics
    /// If the line does not say that it listens.
    pub fn listening(process: Process, line: &str) -> Self {
        let uri = line.strip_prefix("listening on ");
        let uri = uri.unwrap_or_else(|| panic!("the server said {line:?} and not that it listens"));
        let uri = uri.to_owned();
        Self { process, uri }
    }

    /// Its Zenoh locator, `tcp/127.0.0.1:PORT`, read here from the second line that it says.
    ///
    /// # Panics
    /// If it does not listen, or was asked before.
    pub fn zenoh(&mut self) -> String {
        let line = self.process.line().unwrap_or_default();
        let locator = line.strip_prefix("listening on ");
        locator.expect("a server that speaks Zenoh").to_owned()
    }

    /// The address of its pages for operators, read here from the next line that it says.
    ///
    /// # Panics
    /// If it has none, or was asked before.
    pub fn pages(&mut self) -> String {
        let line = self.process.line().unwrap_or_default();
        let address = line.strip_prefix("metrics at ");
        let address = address.and_then(|address| address.strip_suffix("/metrics"));
        let address = address.and_then(|address| Some(address.split_once("://")?.1));
        address.expect("a server with pages").to_owned()
    }

    /// Its gRPC address: `http://127.0.0.1:PORT`.
    pub fn uri(&self) -> &str {
        &self.uri
    }

    /// Its process.
    pub fn process(&self) -> &Process {
        &self.process
    }

    /// Forwards to [`Process::log_until`].
    ///
    /// # Panics
    /// Panics where [`Process::log_until`] does.
    pub fn log_until(&mut self, part: &str) -> Vec<String> {
        self.process.log_until(part)
    }

    /// Waits for its end.
    ///
    /// # Panics
    /// Panics where [`Process::finish`] does.
    pub fn finish(self) -> ProcessOutput {
        self.process.finish()
    }

    /// Sends it a signal and waits for its end.
    ///
    /// # Panics
    /// Panics where [`Process::signal`] and [`Process::finish`] do.
    pub fn stop(self, signal: Signal) -> ProcessOutput {
        self.process.stop(signal)
    }
}

/// Starts the server under test. Arguments are appended to its command line; settings follow a semicolon.
#[macro_export]
macro_rules! server {
    ($($argument:expr),* $(; $($setting:expr),+)?) => {
        $crate::ServerProcess::start_with(
            env!("CARGO_BIN_EXE_server-process"),
            &[$($argument),*],
            &[$($($setting),+)?],
        )
    };
}
