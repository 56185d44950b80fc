//! The clock of each Wayfold server, which the test lets jump.

use std::{
    fs,
    path::{Path, PathBuf},
    process::Command,
    time::SystemTime,
};

use crate::preload::compiled;

/// A day in nanoseconds.
pub(super) const DAY: i64 = 24 * 3600 * 1_000_000_000;

/// The time of day of each server.
pub(super) struct Clocks {
    library: PathBuf,
    directory: PathBuf,
}

impl Clocks {
    /// Clocks that are right.
    pub(super) fn new(directory: &Path, servers: usize) -> Self {
        let clocks = Self {
            library: compiled("clock.c", directory),
            directory: directory.to_owned(),
        };
        for server in 0..servers {
            clocks.jump(server, DAY);
            clocks.check(server);
            clocks.jump(server, 0);
        }
        clocks
    }

    /// This is the control: a program sees that its clock is a day ahead.
    fn check(&self, server: usize) {
        let mut command = Command::new("date");
        command.arg("+%s").envs(self.environment(server));
        let printed = command.output().unwrap().stdout;
        let seconds: u64 = std::str::from_utf8(&printed)
            .unwrap()
            .trim()
            .parse()
            .unwrap();
        let now = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH);
        assert!(seconds > now.unwrap().as_secs() + 23 * 3600, "{seconds}");
    }

    /// Sets the clock of a server this many nanoseconds ahead.
    pub(super) fn jump(&self, server: usize, offset_ns: i64) {
        // The file stays the same: the server has it mapped.
        let mut file = fs::File::options();
        let file = file.write(true).create(true).truncate(false);
        let file = file.open(self.file(server)).unwrap();
        let written = std::os::unix::fs::FileExt::write_at(&file, &offset_ns.to_ne_bytes(), 0);
        assert_eq!(written.unwrap(), 8);
    }

    /// The environment of a server.
    pub(super) fn environment(&self, server: usize) -> [(&'static str, PathBuf); 2] {
        [
            ("LD_PRELOAD", self.library.clone()),
            ("JUMPING_CLOCK", self.file(server)),
        ]
    }

    fn file(&self, server: usize) -> PathBuf {
        self.directory.join(format!("clock-{server}"))
    }
}
