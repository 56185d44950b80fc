//! A disk that can be made to fail: the files of a server, and `tests/power/failing.c` before it.

use std::{fs, path::PathBuf, process::Command};

use wayfold_tests::{Process, ServerProcess};

use crate::preload::compiled;

/// A disk that can be made to fail.
pub(super) struct Disk {
    directory: tempfile::TempDir,
    library: PathBuf,
}

impl Disk {
    /// An empty disk.
    pub(super) fn new() -> Self {
        let directory = tempfile::tempdir().unwrap();
        let library = compiled("failing.c", directory.path());
        Self { directory, library }
    }

    fn root(&self) -> PathBuf {
        self.directory.path().canonicalize().unwrap()
    }

    /// The data directory of servers on it.
    fn data(&self) -> PathBuf {
        self.root().join("data")
    }

    fn control(&self) -> PathBuf {
        self.root().join("control")
    }

    /// Makes the disk fail; `how` is a line of the control file of `failing.c`.
    pub(super) fn fail(&self, how: &str) {
        let new = self.root().join("control.new");
        fs::write(&new, how).unwrap();
        fs::rename(new, self.control()).unwrap();
    }

    /// Ends the failure.
    pub(super) fn mend(&self) {
        fs::remove_file(self.control()).unwrap();
    }

    /// Starts a server whose data is on it.
    pub(super) fn start(&self) -> Process {
        let mut command = Command::new(env!("CARGO_BIN_EXE_server-process"));
        command
            .args(["--grpc", "127.0.0.1:0", "--data"])
            .arg(self.data())
            .env("LD_PRELOAD", &self.library)
            .env("FAILING_DISK", self.data())
            .env("FAILING_CONTROL", self.control());
        Process::spawn(&mut command)
    }

    /// Calls [`Disk::start`], and waits until the server answers.
    pub(super) fn serve(&self) -> ServerProcess {
        ServerProcess::ready(self.start())
    }
}
