//! Marker file `unsynced`: this server ran without fsync and has not shut down cleanly. Acknowledged mutations may be
//! lost then, so every index gets a new uid: one of its revisions may get another content.
//!
//! Under `os`, mutations survive the end of the process, so the file holds the id of the system's boot. If that boot
//! still runs, nothing is lost.

use std::{fs, io, path::Path};

use super::{Durability, directory::sync_directory};

const BOOT: &str = "/proc/sys/kernel/random/boot_id";

pub(super) const FILE: &str = "unsynced";

/// True if the previous server may have lost acknowledged mutations.
pub(super) fn may_have_lost(directory: &Path) -> io::Result<bool> {
    match fs::read_to_string(directory.join(FILE)) {
        Ok(left) => Ok(left.is_empty() || Some(left) != survives(Durability::Os)),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(false),
        Err(error) => Err(error),
    }
}

/// True if the previous server ran without fsync and has not shut down cleanly.
pub(super) fn was_begun(directory: &Path) -> io::Result<bool> {
    directory.join(FILE).try_exists()
}

/// Writes the marker of a server with this setting, or removes it under fsync.
pub(super) fn begin(directory: &Path, durability: Durability) -> io::Result<()> {
    if durability == Durability::Fsync {
        return end(directory);
    }
    let path = directory.join(FILE);
    fs::write(&path, survives(durability).unwrap_or_default())?;
    fs::File::open(&path)?.sync_all()?;
    sync_directory(directory)
}

/// Removes the marker: everything is synced.
pub(super) fn end(directory: &Path) -> io::Result<()> {
    match fs::remove_file(directory.join(FILE)) {
        Ok(()) => sync_directory(directory),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(()),
        Err(error) => Err(error),
    }
}

/// The content of a marker whose mutations only a reboot can lose; None if there is no such content.
fn survives(durability: Durability) -> Option<String> {
    let boot = fs::read_to_string(BOOT).ok()?;
    (durability == Durability::Os).then(|| format!("os {boot}"))
}
