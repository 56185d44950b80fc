//! The log on disk: opened, written to, and damaged in a copy.

use std::{
    fs,
    path::{Path, PathBuf},
};

use wayfold_server::log::{Catalogue, Durability, Entry, FjallLog, LogError, Uid};

use super::{copied::copied, effects, submit, synced};

pub(crate) fn open(directory: &Path) -> FjallLog {
    open_at(directory, Durability::Fsync)
}

pub(crate) fn open_at(directory: &Path, durability: Durability) -> FjallLog {
    FjallLog::open(directory, durability).unwrap()
}

pub(crate) fn append(log: &FjallLog, uid: Uid, revision: u64) {
    let appended = submit(log, uid, revision - 1, effects(revision, &[revision], &[]));
    assert_eq!(appended.unwrap().revision(), revision);
}

pub(crate) fn append_synced(log: &FjallLog, uid: Uid, revision: u64) {
    append(log, uid, revision);
    synced(log, uid, revision).unwrap();
}

/// Asserts that only this index is lost, and returns the reason.
pub(crate) fn only_gone(log: &FjallLog, entry: &Entry) -> LogError {
    let mut gone = log.lost();
    let names: Vec<_> = gone.iter().map(|gone| (&*gone.name, gone.uid)).collect();
    assert_eq!(names, [(&*entry.name, entry.uid)]);
    gone.remove(0).why
}

/// The newest journal of fjall in a directory.
pub(crate) struct JournalFile<'a> {
    directory: &'a Path,
    /// Its path in the directory.
    pub(crate) name: PathBuf,
    /// The number of bytes written to it.
    pub(crate) used: u64,
}

impl<'a> JournalFile<'a> {
    pub(crate) fn of(directory: &'a Path) -> Self {
        let files = fs::read_dir(directory.join("store")).unwrap();
        let journals = files
            .map(|file| file.unwrap().path())
            .filter(|path| path.extension().is_some_and(|kind| kind == "jnl"));
        let path = journals.max().unwrap();
        let bytes = fs::read(&path).unwrap();
        Self {
            directory,
            name: path.strip_prefix(directory).unwrap().into(),
            used: bytes.iter().rposition(|&byte| byte != 0).unwrap() as u64 + 1,
        }
    }

    /// A copy of the directory in which the journal has this length.
    pub(crate) fn cut(&self, length: u64) -> tempfile::TempDir {
        let copy = copied(self.directory);
        let file = fs::File::options()
            .write(true)
            .open(copy.path().join(&self.name));
        file.unwrap().set_len(length).unwrap();
        copy
    }

    /// A copy of the directory in which one bit of this byte of the journal is flipped.
    pub(crate) fn flipped(&self, at: u64) -> tempfile::TempDir {
        let copy = copied(self.directory);
        let path = copy.path().join(&self.name);
        let mut bytes = fs::read(&path).unwrap();
        bytes[at as usize] ^= 0x10;
        fs::write(path, bytes).unwrap();
        copy
    }
}

/// A part of a directory that can be removed and put back.
pub(crate) struct Part {
    path: PathBuf,
    away: PathBuf,
}

impl Part {
    pub(crate) fn of(directory: &Path, name: impl AsRef<Path>) -> Self {
        Self {
            path: directory.join(name),
            away: directory.join("away"),
        }
    }

    pub(crate) fn take_away(&self) {
        fs::rename(&self.path, &self.away).unwrap();
    }

    pub(crate) fn bring_back(&self) {
        fs::rename(&self.away, &self.path).unwrap();
    }
}
