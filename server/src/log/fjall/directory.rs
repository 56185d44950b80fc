//! The data directory: its ownership check and its lock.
//!
//! | name | content |
//! |---|---|
//! | `wayfold-data` | one line that names the program and the version of the form; locked while a server runs |
//! | `store/` | the files of fjall: see [`layout`](super::layout) |
//! | `store.new/` | a store that is being made |
//! | `store.rebuilt/` | a rebuilt store that has yet to replace the damaged one: see [`rebuild`](super::rebuild) |
//! | `store.damaged-N/` | a damaged store from before a repair; nothing reads it |
//! | `marks` | the last synced revision of each index: see [`sync_marks`](super::sync_marks) |
//! | `marks.new` | exists while `marks` is rewritten |
//! | `manifest-copy` | a copy of the small files that all indices share: see [`manifest_copy`](super::manifest_copy) |
//! | `journal-synced` | exists after a clean shutdown: see [`journal`](super::journal) |
//! | `journal-cut` | the bytes last cut off the journal; nothing reads it: see [`torn_batch`](super::torn_batch) |
//! | `unsynced` | exists while a server without fsync runs: see [`unclean_marker`](super::unclean_marker) |
//! | `probe` | exists briefly, during a test that the disk can be written |

use std::{
    fs::{self, File, TryLockError},
    io::{self, Read, Seek, Write},
    path::{Path, PathBuf},
};

use thiserror::Error;

use super::{MARKS, REBUILT_STORE, STORE};

const MARKER: &str = "wayfold-data";
const FORM: &str = "wayfold-server data, version ";
const VERSION: &str = "4";

/// The older version that this program reads. It differs from [`VERSION`] only by having no writer sessions.
const OLDER_VERSION: &str = "3";

const PROBE: &str = "probe";
/// Enough room for a reopened store to begin with, in addition to the bytes that it has yet to move out of its journal.
const PROBE_BYTES: u64 = 4 * 1024 * 1024;

/// The error of opening a data directory.
#[derive(Debug, Error)]
pub enum OpenError {
    /// It holds no store, and the command makes none.
    #[error("there is no store in {}: name the data directory with --data", directory.display())]
    Missing {
        /// The directory.
        directory: PathBuf,
    },
    /// It belongs to another program.
    #[error(
        "{} is not a data directory of wayfold-server: it holds other files; name another one, or an empty one, with \
         --data",
        directory.display()
    )]
    Foreign {
        /// The directory.
        directory: PathBuf,
    },
    /// Its marker is missing or damaged, and the rest looks like data of a wayfold-server.
    #[error(
        "the file {MARKER} in {} is missing or damaged, and the rest looks like the data of a wayfold-server: if it \
         is, write the line \"{FORM}{VERSION}\" into that file; else name another directory with --data",
        directory.display()
    )]
    Marker {
        /// The directory.
        directory: PathBuf,
    },
    /// Another version of this program wrote it.
    #[error(
        "{} is of version \"{found}\", and this server reads the versions {OLDER_VERSION} and {VERSION} only: start \
         the server that wrote it, or name another directory with --data",
        directory.display()
    )]
    Version {
        /// The directory.
        directory: PathBuf,
        /// The version.
        found: String,
    },
    /// A running server uses it.
    #[error(
        "{} is in use by another wayfold-server: stop that one, or name another directory with --data",
        directory.display()
    )]
    InUse {
        /// The directory.
        directory: PathBuf,
    },
    /// The operating system refused.
    #[error(
        "cannot use {}: {source}; see that this user may write there and that the disk has room, or name another \
         directory with --data",
        path.display()
    )]
    Io {
        /// The file or directory.
        path: PathBuf,
        /// The cause.
        source: io::Error,
    },
}

/// A data directory, locked while this value lives.
pub(super) struct Directory {
    path: PathBuf,
    locked: File,
}

impl Directory {
    /// Locks a data directory, and creates it if it is missing.
    pub(super) fn take(path: &Path) -> Result<Self, OpenError> {
        let failed = |source| OpenError::Io {
            path: path.into(),
            source,
        };
        make_directory(path).map_err(failed)?;
        let marker = path.join(MARKER);
        if !marker.try_exists().map_err(failed)? && !is_empty(path).map_err(failed)? {
            return Err(foreign(path));
        }
        let mut file = File::options()
            .read(true)
            .write(true)
            .create(true)
            .truncate(false)
            .open(&marker)
            .map_err(failed)?;
        match file.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => {
                return Err(OpenError::InUse {
                    directory: path.into(),
                });
            }
            Err(TryLockError::Error(error)) => return Err(failed(error)),
        }
        check(&mut file, path)?;
        Ok(Self {
            path: path.into(),
            locked: file,
        })
    }

    /// Writes the marker of this version durably, before anything is written that the older version does not know.
    /// From then on a server of that version, which would lose the writer sessions, refuses the directory.
    pub(super) fn upgrade(&self) -> io::Result<()> {
        let (mut file, this) = (&self.locked, format!("{VERSION}\n"));
        let start = io::SeekFrom::Start(FORM.len() as u64);
        let mut found = String::new();
        file.seek(start)?;
        file.read_to_string(&mut found)?;
        if found == this {
            return Ok(());
        }
        // The lengths are the same, so an interruption leaves one version or the other.
        file.seek(start)?;
        file.write_all(this.as_bytes())?;
        file.sync_all()
    }

    /// Fails if the disk cannot be written, if it would have no room for `bytes` and some more once `freed` bytes were
    /// given back, or if `name` is missing.
    pub(super) fn probe(&self, name: &str, bytes: u64, freed: u64) -> io::Result<()> {
        fs::metadata(self.join(name))?;
        let path = self.join(PROBE);
        let written = File::create(&path).and_then(|mut file| {
            let bytes = (PROBE_BYTES + bytes).saturating_sub(freed);
            io::copy(&mut io::repeat(0).take(bytes), &mut file)?;
            file.sync_all()
        });
        let removed = fs::remove_file(&path);
        written.and(removed)
    }

    /// The free bytes of its disk.
    pub(super) fn room(&self) -> io::Result<u64> {
        #[cfg(unix)]
        {
            let disk = rustix::fs::statvfs(&self.path)?;
            Ok(disk.f_bavail.saturating_mul(disk.f_frsize))
        }
        // On other systems a repair without enough room fails halfway, and the damaged store stays.
        #[cfg(not(unix))]
        Ok(u64::MAX)
    }

    /// The path of a file or directory in it.
    pub(super) fn join(&self, name: &str) -> PathBuf {
        self.path.join(name)
    }

    pub(super) fn path(&self) -> &Path {
        &self.path
    }
}

impl Drop for Directory {
    fn drop(&mut self) {
        // Closing the file is not enough while a child process is being started: the child shares the file until then.
        // Unlocking fails only if there is no lock.
        let _ = self.locked.unlock();
    }
}

/// Fails if a directory holds no store, not even one that a repair has yet to put in place.
pub(super) fn require_store(path: &Path) -> Result<(), OpenError> {
    for name in [STORE, REBUILT_STORE] {
        let found = path.join(name).try_exists();
        if found.map_err(|source| OpenError::Io {
            path: path.into(),
            source,
        })? {
            return Ok(());
        }
    }
    Err(OpenError::Missing {
        directory: path.into(),
    })
}

/// Checks the marker. An empty marker was just made or was not finished, and is written.
fn check(file: &mut File, path: &Path) -> Result<(), OpenError> {
    let failed = |source| OpenError::Io {
        path: path.join(MARKER),
        source,
    };
    let line = format!("{FORM}{VERSION}\n");
    let mut found = Vec::new();
    file.take(1000).read_to_end(&mut found).map_err(failed)?;
    let found = String::from_utf8_lossy(&found).into_owned();
    let version = found.strip_prefix(FORM);
    let version = version.map(str::trim_end);
    if let Some(VERSION | OLDER_VERSION) = version {
        return Ok(());
    }
    if line.starts_with(&found) && only_the_marker(path).map_err(failed)? {
        file.write_all(&line.as_bytes()[found.len()..])
            .and_then(|()| file.sync_all())
            .and_then(|()| sync_directory(path))
            .map_err(failed)?;
        return Ok(());
    }
    match version {
        Some(version) => Err(OpenError::Version {
            directory: path.into(),
            found: version.into(),
        }),
        None => Err(foreign(path)),
    }
}

/// The error of a directory without our marker.
fn foreign(path: &Path) -> OpenError {
    let directory = path.into();
    match [STORE, MARKS].iter().all(|name| path.join(name).exists()) {
        true => OpenError::Marker { directory },
        false => OpenError::Foreign { directory },
    }
}

fn is_empty(path: &Path) -> io::Result<bool> {
    Ok(fs::read_dir(path)?.next().is_none())
}

fn only_the_marker(path: &Path) -> io::Result<bool> {
    for file in fs::read_dir(path)? {
        if file?.file_name() != MARKER {
            return Ok(false);
        }
    }
    Ok(true)
}

/// Creates a directory and its missing parents, and makes their names durable.
pub(crate) fn make_directory(path: &Path) -> io::Result<()> {
    let missing = |path: &&Path| !path.as_os_str().is_empty() && !path.exists();
    let made: Vec<&Path> = path.ancestors().take_while(missing).collect();
    fs::create_dir_all(path)?;
    for parent in made.iter().filter_map(|path| path.parent()) {
        let is_current = parent.as_os_str().is_empty();
        sync_directory(if is_current { Path::new(".") } else { parent })?;
    }
    Ok(())
}

/// Makes the names in a directory and in every directory under it durable.
pub(super) fn sync_directories(path: &Path) -> io::Result<()> {
    for file in fs::read_dir(path)? {
        let file = file?;
        if file.file_type()?.is_dir() {
            sync_directories(&file.path())?;
        }
    }
    sync_directory(path)
}

/// Makes names in a directory durable.
pub(super) fn sync_directory(path: &Path) -> io::Result<()> {
    // On other systems a directory cannot be opened as a file, and its names are durable with the files.
    if cfg!(unix) {
        File::open(path)?.sync_all()?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn refusal(path: &Path) -> String {
        let refused = Directory::take(path).err().unwrap();
        assert!(refused.to_string().contains(&*path.to_string_lossy()));
        refused.to_string()
    }

    /// A loop of links stands for a missing right: root has every right.
    #[cfg(unix)]
    #[test]
    fn a_directory_that_cannot_be_searched_is_not_said_to_have_no_store() {
        let directory = tempfile::tempdir().unwrap();
        let missing = require_store(directory.path()).unwrap_err();
        assert!(matches!(missing, OpenError::Missing { .. }), "{missing}");
        let itself = directory.path().join("loop");
        std::os::unix::fs::symlink(&itself, &itself).unwrap();
        let refused = require_store(&itself).unwrap_err();
        assert!(matches!(refused, OpenError::Io { .. }), "{refused}");
    }

    #[test]
    fn only_a_directory_of_ours_or_an_empty_one_is_taken() {
        let directory = tempfile::tempdir().unwrap();
        let ours = directory.path().join("a/b");
        drop(Directory::take(&ours).unwrap());
        let held = Directory::take(&ours).unwrap();
        assert!(refusal(&ours).contains("in use"));
        drop(held);
        fs::write(ours.join("more"), "").unwrap();
        drop(Directory::take(&ours).unwrap());
        // An editor may end the line in its own way.
        fs::write(ours.join(MARKER), format!("{FORM}{VERSION}\r\n")).unwrap();
        drop(Directory::take(&ours).unwrap());
        fs::write(ours.join(MARKER), format!("{FORM}9\n")).unwrap();
        assert!(refusal(&ours).contains("version \"9\""));
        fs::write(ours.join(MARKER), "hello").unwrap();
        assert!(refusal(&ours).contains("not a data directory"));
        assert!(refusal(directory.path()).contains("not a data directory"));
    }

    #[test]
    fn the_refusal_of_a_damaged_marker_says_how_to_mend_it() {
        let directory = tempfile::tempdir().unwrap();
        let ours = directory.path();
        drop(Directory::take(ours).unwrap());
        fs::write(ours.join(MARKS), "").unwrap();
        fs::create_dir(ours.join(STORE)).unwrap();
        let marker = ours.join(MARKER);
        let whole = fs::read_to_string(&marker).unwrap();
        for damaged in [
            &b""[..],
            b"wayfold-sErver",
            b"\xff\xfe",
            b"wayfold-server data, ver",
        ] {
            fs::write(&marker, damaged).unwrap();
            let refusal = refusal(ours);
            assert!(refusal.contains("missing or damaged"), "{refusal}");
            assert!(refusal.contains(whole.trim_end()), "{refusal}");
        }
        fs::remove_file(&marker).unwrap();
        assert!(refusal(ours).contains("missing or damaged"));
        fs::write(&marker, whole).unwrap();
        Directory::take(ours).unwrap();
    }

    #[test]
    fn a_marker_that_was_not_finished_is() {
        let directory = tempfile::tempdir().unwrap();
        fs::write(directory.path().join(MARKER), &FORM[..9]).unwrap();
        drop(Directory::take(directory.path()).unwrap());
        let marker = fs::read_to_string(directory.path().join(MARKER)).unwrap();
        assert_eq!(marker, format!("{FORM}{VERSION}\n"));
    }
}
