//! Libraries that are put before a server by `LD_PRELOAD`, and stand between it and its files.

use std::{
    path::{Path, PathBuf},
    process::Command,
};

/// Compiles a source of `tests/power` into `directory`. Rust needs the system's `cc` to link, so it is there.
pub(crate) fn compiled(name: &str, directory: &Path) -> PathBuf {
    let library = directory.join(name).with_extension("so");
    let source = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("power")
        .join(name);
    let compiled = Command::new("cc")
        .args(["-shared", "-fPIC", "-O1", "-Wall", "-Wextra", "-Werror"])
        // It replaces the very functions that this would wrap.
        .arg("-U_FORTIFY_SOURCE")
        .args([Path::new("-o"), &library, &source])
        .status();
    assert!(compiled.unwrap().success(), "cc");
    library
}
