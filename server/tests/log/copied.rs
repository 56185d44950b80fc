//! What a crash would leave.

use std::{path::Path, process::Command};

/// The files of a directory as they are now. The copy of a lock is not locked.
pub(crate) fn copied(directory: &Path) -> tempfile::TempDir {
    let copy = tempfile::tempdir().unwrap();
    let mut command = Command::new("cp");
    command.arg("-R").arg(directory.join(".")).arg(copy.path());
    assert!(command.status().unwrap().success());
    copy
}
