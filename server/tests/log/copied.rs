//! What a crash would leave.

use std::{fs, path::Path, process::Command};

/// How often a copy is begun anew, at most: who copies a log writes little to it meanwhile.
const TRIES: usize = 100;

/// The files of a log as they were at one moment. The copy of a lock is not locked.
pub(crate) fn copied(directory: &Path) -> tempfile::TempDir {
    // A mark is written after what it speaks of, and never the same twice: while the marks stay as they are, the rest
    // that is copied goes with them.
    let marks = || fs::read(directory.join("marks")).unwrap();
    for _ in 0..TRIES {
        let before = marks();
        let copy = tempfile::tempdir().unwrap();
        let mut command = Command::new("cp");
        command.arg("-R").arg(directory.join(".")).arg(copy.path());
        assert!(command.status().unwrap().success());
        if marks() == before {
            return copy;
        }
    }
    panic!("the log is written on and on");
}
