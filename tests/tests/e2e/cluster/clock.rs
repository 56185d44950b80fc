//! The clocks of the servers of Wayfold, each of which jumps.

use std::{
    fs,
    path::{Path, PathBuf},
};

use crate::preload::compiled;

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
            clocks.jump(server, 0);
        }
        clocks
    }

    /// Sets the clock of a server this many nanoseconds ahead.
    pub(super) fn jump(&self, server: usize, ahead: i64) {
        // The file stays the same: the server has it mapped.
        let mut file = fs::File::options();
        let file = file.write(true).create(true).truncate(false);
        let file = file.open(self.file(server)).unwrap();
        let written = std::os::unix::fs::FileExt::write_at(&file, &ahead.to_ne_bytes(), 0);
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
