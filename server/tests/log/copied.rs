//! Copies a log in the state that a crash would leave.

use std::{fs, path::Path, process::Command};

/// The maximum number of attempts to copy a log; callers write little to it meanwhile.
const MAX_ATTEMPTS: usize = 100;

/// Copies the files of a log as they are at one moment. The copied lock is not locked.
pub(crate) fn copied(directory: &Path) -> tempfile::TempDir {
    // A mark is written after the data it describes, and never the same twice. While the marks stay as they are, the
    // rest of the copy matches them.
    let marks = || fs::read(directory.join("marks")).unwrap();
    for _ in 0..MAX_ATTEMPTS {
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
