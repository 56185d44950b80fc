//! What a server that does not sync leaves behind if it does not end well: the file `unsynced`. Mutations that were
//! acknowledged may be gone then, so every index gets a new uid: a revision may come to mean something else.
//!
//! A setting `os` survives the end of the process, so the file holds the name of the system's boot: found again under
//! the same one, nothing is lost.

use std::{fs, io, path::Path};

use super::{Durability, directory::sync_directory};

const BOOT: &str = "/proc/sys/kernel/random/boot_id";

/// The name of the file.
pub(super) const FILE: &str = "unsynced";

/// Whether the server that was here before may have lost what it acknowledged.
pub(super) fn may_have_lost(directory: &Path) -> io::Result<bool> {
    match fs::read_to_string(directory.join(FILE)) {
        Ok(left) => Ok(left.is_empty() || Some(left) != survives(Durability::Os)),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(false),
        Err(error) => Err(error),
    }
}

/// Whether the server that was here before did not sync, and did not end well.
pub(super) fn was_begun(directory: &Path) -> io::Result<bool> {
    directory.join(FILE).try_exists()
}

/// Says that a server with this setting is at work here.
pub(super) fn begin(directory: &Path, durability: Durability) -> io::Result<()> {
    if durability == Durability::Fsync {
        return end(directory);
    }
    let path = directory.join(FILE);
    fs::write(&path, survives(durability).unwrap_or_default())?;
    fs::File::open(&path)?.sync_all()?;
    sync_directory(directory)
}

/// Says that all is synced.
pub(super) fn end(directory: &Path) -> io::Result<()> {
    match fs::remove_file(directory.join(FILE)) {
        Ok(()) => sync_directory(directory),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(()),
        Err(error) => Err(error),
    }
}

/// What the file holds if nothing is lost until the system goes down; None if that cannot be told.
fn survives(durability: Durability) -> Option<String> {
    let boot = fs::read_to_string(BOOT).ok()?;
    (durability == Durability::Os).then(|| format!("os {boot}"))
}
