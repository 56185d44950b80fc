//! A disk whose power can be cut: the files of a server, and the shadow that `tests/power/disk.c` keeps of them.

use std::{
    fs,
    path::{Path, PathBuf},
    process::Command,
};

use wayfold_tests::{Process, ServerProcess};

use crate::preload::compiled;

/// A disk. A server on it sees its files as they are written. Once the power is cut, only the durable part is left.
pub(super) struct Disk {
    directory: tempfile::TempDir,
    library: PathBuf,
    cuts: u64,
    /// If present, the disk also writes some data that no sync asked for; the seed draws which.
    unasked: Option<u64>,
}

impl Disk {
    /// An empty disk.
    pub(super) fn new(unasked: Option<u64>) -> Self {
        let directory = tempfile::tempdir().unwrap();
        let library = compiled("disk.c", directory.path());
        let disk = Self {
            directory,
            library,
            cuts: 0,
            unasked,
        };
        fs::create_dir(disk.files()).unwrap();
        fs::create_dir(disk.shadow()).unwrap();
        disk
    }

    /// The root of its files.
    fn files(&self) -> PathBuf {
        let path = self.directory.path().canonicalize().unwrap();
        path.join(format!("disk-{}", self.cuts))
    }

    fn shadow(&self) -> PathBuf {
        self.directory.path().join(format!("shadow-{}", self.cuts))
    }

    /// The pipe into which readers write after each read; a sync lasts until one has.
    pub(super) fn looked(&self) -> PathBuf {
        self.directory.path().join("looked")
    }

    /// Starts a server whose data is on it, with settings in its environment. Only one start is allowed between two
    /// cuts, because the files at the start count as durable.
    pub(super) fn start(&self, settings: &[(&str, &str)]) -> Process {
        let mut command = Command::new(env!("CARGO_BIN_EXE_server-process"));
        command
            .args(["--grpc", "127.0.0.1:0", "--data"])
            .arg(self.files().join("data"))
            .env("LD_PRELOAD", &self.library)
            .env("POWER_DISK", self.files())
            .env("POWER_SHADOW", self.shadow())
            .env("POWER_LOOKED", self.looked())
            .envs(settings.iter().copied());
        if let Some(seed) = self.unasked {
            command.env("POWER_SEED", (seed + self.cuts).to_string());
        }
        Process::spawn(&mut command)
    }

    /// Calls [`Disk::start`], and waits until the server answers.
    pub(super) fn serve(&self, settings: &[(&str, &str)]) -> ServerProcess {
        ServerProcess::ready(self.start(settings))
    }

    /// Removes all files from it.
    pub(super) fn erase(&mut self) {
        fs::remove_dir_all(self.files()).unwrap();
        fs::remove_dir_all(self.shadow()).unwrap();
        fs::create_dir(self.files()).unwrap();
        fs::create_dir(self.shadow()).unwrap();
    }

    /// Cuts the power. The server on it must have been killed.
    pub(super) fn cut(&mut self) {
        let (files, shadow) = (self.files(), self.shadow());
        self.cuts += 1;
        Self::check(&shadow);
        if shadow.join("0").exists() {
            durable(&shadow, 0, true, &self.files());
            fs::remove_dir_all(files).unwrap();
        } else {
            // The program had not begun to write.
            fs::rename(files, self.files()).unwrap();
        }
        fs::remove_dir_all(shadow).unwrap();
        fs::create_dir(self.shadow()).unwrap();
    }

    /// Checks that the shadow of a server that has ended in order equals its files: the shadow missed no write.
    pub(super) fn check_shadow(&self) {
        Self::check(&self.shadow());
        let copy = self.directory.path().join("copy");
        durable(&self.shadow(), 0, true, &copy);
        let mut same = Command::new("diff");
        let same = same
            .arg("-r")
            .args([&copy, &self.files()])
            .output()
            .unwrap();
        assert!(same.status.success(), "{same:?}");
        fs::remove_dir_all(copy).unwrap();
    }

    fn check(shadow: &Path) {
        let trouble = fs::read_to_string(shadow.join("trouble")).unwrap_or_default();
        assert_eq!(trouble, "");
    }
}

/// Restores an object of the shadow, with everything under it.
fn durable(shadow: &Path, number: u32, directory: bool, to: &Path) {
    let content = shadow.join(number.to_string());
    if !content.exists() {
        fs::write(&content, "").unwrap();
    }
    if !directory {
        fs::hard_link(content, to).unwrap();
        return;
    }
    fs::create_dir(to).unwrap();
    for line in fs::read_to_string(content).unwrap().lines() {
        let mut parts = line.splitn(3, ' ');
        let mut part = || parts.next().unwrap();
        let (kind, number, name) = (part(), part().parse().unwrap(), part());
        durable(shadow, number, kind == "d", &to.join(name));
    }
}
