//! Syncs the journal of the store without blocking its writers.
//!
//! `Database::persist` holds the journal's lock during the sync, so writers would queue behind each sync instead of
//! sharing the next one. So fjall only writes its buffer to the operating system under that lock. The file is then synced
//! here, through a handle of our own.
//!
//! This relies on the journal of fjall 3. Its files are named `N.jnl`, and fjall writes to the one with the largest N.
//! It syncs a file before it makes the next one. So every batch committed before [`StoreJournal::sync`] is in the file with
//! the largest N, or is already synced. There is one exception: if fjall fails to make that file, it leaves the file
//! empty, and writes to the previous one until every thread has seen the failure.

use std::{
    fs,
    fs::File,
    io::{self, Read, Seek, SeekFrom, Write},
    path::{Path, PathBuf},
    sync::Arc,
};

use fjall::PersistMode;

use super::{
    STORE,
    directory::{Directory, sync_directory},
    store::{Store, storage},
};
use crate::log::LogError;

/// The suffix of its files' names.
const SUFFIX: &str = ".jnl";
/// Marker file: the journal is on disk. It exists from a clean shutdown until the next start.
const MARKER: &str = "journal-synced";
/// The number of bytes that are rewritten at a time.
const COPY_BYTES: usize = 128 * 1024;

/// The journal of a store.
pub(super) struct StoreJournal {
    store: Arc<Store>,
    directory: PathBuf,
    /// The newest file, by its number.
    newest: Option<(u64, File)>,
    /// The previous file, while the newest one is empty.
    before: Option<File>,
}

impl StoreJournal {
    /// The journal of `store`, whose files are in `directory`.
    pub(super) fn new(store: Arc<Store>, directory: PathBuf) -> Self {
        Self {
            store,
            directory,
            newest: None,
            before: None,
        }
    }

    /// Returns once every earlier commit is on disk, or returns the error.
    pub(super) fn sync(&mut self) -> Result<(), LogError> {
        let handles = self.store.handles()?;
        let persisted = handles.database.persist(PersistMode::Buffer);
        drop(handles);
        persisted.map_err(storage)?;
        self.sync_newest().map_err(|error| LogError::Storage {
            what: format!("cannot sync the journal files: {error}"),
        })
    }

    fn sync_newest(&mut self) -> io::Result<()> {
        let number = self.newest_number()?;
        if self
            .newest
            .as_ref()
            .is_none_or(|(known, _)| *known != number)
        {
            let file = File::options()
                .read(true)
                .write(true)
                .open(self.file(number))?;
            let before = self.newest.replace((number, file));
            self.before = before.map(|(_, file)| file);
        }
        let Some((_, newest)) = &mut self.newest else {
            return Ok(());
        };
        if let Some(before) = &self.before {
            if is_begun(newest)? {
                self.before = None;
            } else {
                before.sync_data()?;
            }
        }
        newest.sync_data()
    }

    fn newest_number(&self) -> io::Result<u64> {
        // File numbers are consecutive, and the oldest files are removed first. So if this file exists and the next
        // does not, this one is the newest. Every sync checks this, and two lookups cost less than a listing.
        if let Some((known, _)) = self.newest
            && self.file(known).try_exists()?
            && !self.file(known + 1).try_exists()?
        {
            return Ok(known);
        }
        let mut newest = None;
        for file in fs::read_dir(&self.directory)? {
            newest = newest.max(file?.file_name().to_str().and_then(number));
        }
        newest.ok_or_else(|| io::Error::other("it has no file"))
    }

    fn file(&self, number: u64) -> PathBuf {
        self.directory.join(format!("{number}{SUFFIX}"))
    }
}

/// The number in the name of a journal file; None for any other file.
pub(super) fn number(name: &str) -> Option<u64> {
    name.strip_suffix(SUFFIX)?.parse().ok()
}

/// Ensures that the journal is on disk before the store is opened. Without the marker, the whole journal is rewritten
/// in place and synced. Returns true if there was a marker, which is removed.
///
/// After a failed sync, by this server or an earlier one, Linux treats the pages that it could not write as clean.
/// Reads return them as if they were on disk, and no later sync writes them.
pub(super) fn ensure_durable(directory: &Directory) -> io::Result<bool> {
    let marker = directory.join(MARKER);
    if !marker.try_exists()? {
        let store = directory.join(STORE);
        for file in files(&store)? {
            rewrite_file(&mut File::options().read(true).write(true).open(file)?)?;
        }
        // fjall writes to a file even if it failed to make the file's name durable.
        sync_directory(&store)?;
        return Ok(false);
    }
    fs::remove_file(&marker)?;
    // The removal of the marker must be durable before the first write to the journal.
    sync_directory(directory.path())?;
    Ok(true)
}

/// Syncs each file of the journal and writes the marker. The store must be closed, and none of its syncs may have
/// failed.
pub(super) fn mark_synced(directory: &Directory) -> io::Result<()> {
    for file in files(&directory.join(STORE))? {
        File::options().write(true).open(file)?.sync_all()?;
    }
    File::create(directory.join(MARKER))?.sync_all()?;
    sync_directory(directory.path())
}

/// The files of the journal in a store.
pub(super) fn files(store: &Path) -> io::Result<Vec<PathBuf>> {
    let mut files = Vec::new();
    for file in fs::read_dir(store)? {
        let file = file?;
        if file.file_name().to_str().and_then(number).is_some() {
            files.push(file.path());
        }
    }
    Ok(files)
}

fn rewrite_file(file: &mut File) -> io::Result<()> {
    let mut piece = vec![0; COPY_BYTES];
    let mut at = 0;
    loop {
        file.seek(SeekFrom::Start(at))?;
        let read = file.read(&mut piece)?;
        if read == 0 {
            return file.sync_all();
        }
        // The preallocated room is a hole, and stays one: a full disk has no other.
        let end = piece[..read].iter().rposition(|&byte| byte != 0);
        if let Some(last) = end {
            file.seek(SeekFrom::Start(at))?;
            file.write_all(&piece[..=last])?;
        }
        at += read as u64;
    }
}

/// True if anything was written to a journal file. A new file is full of zeros, and no entry begins with a zero.
fn is_begun(file: &mut File) -> io::Result<bool> {
    let mut first = [0];
    file.seek(SeekFrom::Start(0))?;
    let found = file.read(&mut first)?;
    Ok(found > 0 && first != [0])
}

#[cfg(test)]
mod tests {
    use super::{
        super::{Durability, store::Handles},
        *,
    };

    /// On a full disk there is no other.
    #[cfg(unix)]
    #[test]
    fn a_rewritten_file_takes_no_more_room() {
        use std::os::unix::fs::MetadataExt;

        let mut file = tempfile::tempfile().unwrap();
        file.set_len(4 * COPY_BYTES as u64).unwrap();
        file.write_all(&[0, 7, 0, 7]).unwrap();
        file.sync_all().unwrap();
        let blocks = file.metadata().unwrap().blocks();
        rewrite_file(&mut file).unwrap();
        assert_eq!(file.metadata().unwrap().blocks(), blocks);
        let mut content = Vec::new();
        file.seek(SeekFrom::Start(0)).unwrap();
        file.read_to_end(&mut content).unwrap();
        assert_eq!(content[..5], [0, 7, 0, 7, 0]);
        assert_eq!(content.len(), 4 * COPY_BYTES);
    }

    /// Checks the module's assumption about fjall's files, to detect a version of fjall that behaves otherwise.
    #[test]
    fn a_synced_commit_is_in_the_newest_file() {
        let directory = tempfile::tempdir().unwrap();
        let store = Arc::new(Store::open(directory.path(), Durability::Fsync).unwrap());
        let mut journal = StoreJournal::new(Arc::clone(&store), directory.path().into());
        let mut numbers = Vec::new();
        for round in 0..3u8 {
            let value = [b'a' + round; 100];
            let Handles {
                database, keyspace, ..
            } = &*store.handles().unwrap();
            let mut batch = database.batch();
            batch.insert(keyspace, [round], value);
            batch.commit().unwrap();
            journal.sync().unwrap();
            let (number, _) = journal.newest.as_ref().unwrap();
            let bytes = fs::read(directory.path().join(format!("{number}.jnl"))).unwrap();
            let written = bytes.split(|&byte| byte == 0);
            assert!(
                written
                    .flat_map(|part| part.windows(100))
                    .any(|found| found == value)
            );
            numbers.push(*number);
            // Enough zeros that fjall begins another file when it moves them out. A thread of its own may begin with that
            // before the first call, which does not wait then; the second one waits for both.
            for zeros in [65_000_000, 1] {
                keyspace.insert("much", vec![0; zeros]).unwrap();
                keyspace.rotate_memtable_and_wait().unwrap();
            }
        }
        assert!(numbers.is_sorted_by(|a, b| a < b), "{numbers:?}");
    }

    #[test]
    fn a_start_rewrites_the_journal_unless_the_shutdown_was_clean() {
        let directory = tempfile::tempdir().unwrap();
        let directory = Directory::take(directory.path()).unwrap();
        let path = directory.join(STORE).join("0.jnl");
        fs::create_dir(directory.join(STORE)).unwrap();
        fs::write(&path, "entries").unwrap();
        for is_clean in [false, true, false] {
            if is_clean {
                mark_synced(&directory).unwrap();
            }
            let long_ago = std::time::UNIX_EPOCH;
            let file = File::options().write(true).open(&path).unwrap();
            file.set_modified(long_ago).unwrap();
            ensure_durable(&directory).unwrap();
            let modified = file.metadata().unwrap().modified().unwrap();
            assert_eq!(modified == long_ago, is_clean);
            assert_eq!(fs::read(&path).unwrap(), b"entries");
        }
    }

    /// The state after a rotation that failed for want of room: fjall still writes to the previous file.
    #[test]
    fn a_file_that_was_made_and_is_not_written_to_does_not_hide_the_one_before() {
        let directory = tempfile::tempdir().unwrap();
        let store = Arc::new(Store::open(directory.path(), Durability::Fsync).unwrap());
        let mut journal = StoreJournal::new(Arc::clone(&store), directory.path().into());
        journal.sync().unwrap();
        let (written, _) = journal.newest.as_ref().unwrap();
        let new = directory.path().join(format!("{}.jnl", written + 1));
        for length in [0, 4096] {
            fs::write(&new, vec![0; length]).unwrap();
            for _ in 0..2 {
                journal.sync().unwrap();
                assert!(journal.before.is_some());
            }
        }
        fs::write(&new, [1]).unwrap();
        journal.sync().unwrap();
        assert!(journal.before.is_none());
    }
}
