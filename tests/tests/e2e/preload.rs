//! Libraries that `LD_PRELOAD` puts between a server and its files.

use std::{
    path::{Path, PathBuf},
    process::Command,
};

/// Compiles a source of `tests/power` into `directory`. The system's `cc` exists, because Rust links with it.
pub(crate) fn compiled(name: &str, directory: &Path) -> PathBuf {
    let library = directory.join(name).with_extension("so");
    let source = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("power")
        .join(name);
    let compiled = Command::new("cc")
        .args(["-shared", "-fPIC", "-O1", "-Wall", "-Wextra", "-Werror"])
        // The source replaces the functions that this macro would wrap.
        .arg("-U_FORTIFY_SOURCE")
        .args([Path::new("-o"), &library, &source])
        .status();
    assert!(compiled.unwrap().success(), "cc");
    library
}
