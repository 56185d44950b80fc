//! Syncing the journal of the store without holding up who writes to it.
//!
//! `Database::persist` holds the journal's lock while the disk works, so writers would queue behind each sync instead
//! of sharing the next. So only what fjall still buffers is handed to the operating system under that lock, and the
//! file is synced here, through a handle of our own.
//!
//! This relies on how fjall 3 keeps its journal: files `N.jnl`, of which the one with the largest N is written to, and
//! the one before was synced before the next was made. Whatever was committed before [`Journal::sync`] is therefore in
//! the largest file that it finds, or synced already. Unless fjall has failed to make that file: it leaves it there with
//! nothing in it, and writes to the one before until all know of the failure.

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
    store::{Store, told},
};

/// The ending of its files' names.
const ENDING: &str = ".jnl";
/// Marker file: the journal is on disk, after a clean end and until the next start.
const MARKER: &str = "journal-synced";
/// Bytes to write again at a time.
const PIECE: usize = 128 * 1024;

/// The journal of a store.
pub(super) struct Journal {
    store: Arc<Store>,
    directory: PathBuf,
    /// The newest file, by its number.
    newest: Option<(u64, File)>,
    /// The one before, as long as nothing was found in the newest.
    before: Option<File>,
}

impl Journal {
    /// The journal of `store`, which lives in `directory`.
    pub(super) fn new(store: Arc<Store>, directory: PathBuf) -> Self {
        Self {
            store,
            directory,
            newest: None,
            before: None,
        }
    }

    /// Returns when all that was committed before is on disk, or says why not.
    pub(super) fn sync(&mut self) -> Result<(), String> {
        let handles = self.store.handles().map_err(|error| error.to_string())?;
        let handed_on = handles.database.persist(PersistMode::Buffer);
        drop(handles);
        handed_on.map_err(told)?;
        self.sync_newest()
            .map_err(|error| format!("cannot sync the journal: {error}"))
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
        // Files are numbered one by one, and the oldest are removed first: if this one is there and the next is not,
        // there is no other. Looking for two is less work than listing all, as a sync does that every time.
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
        self.directory.join(format!("{number}{ENDING}"))
    }
}

/// The number of a file of the journal, by its name; None for any other.
pub(super) fn number(name: &str) -> Option<u64> {
    name.strip_suffix(ENDING)?.parse().ok()
}

/// Makes certain that the journal is on disk, before the store is opened. Without the marker, all of it is written once more
/// in place and synced.
///
/// After a failed sync, by this server or an earlier one, Linux takes pages that it could not write for clean: reads see them
/// as if they were on disk, and no later sync writes them.
pub(super) fn make_certain(directory: &Directory) -> io::Result<()> {
    let marker = directory.join(MARKER);
    if !marker.try_exists()? {
        for file in files(&directory.join(STORE))? {
            write_file_again(&mut File::options().read(true).write(true).open(file)?)?;
        }
        return Ok(());
    }
    fs::remove_file(&marker)?;
    // Before the first write to the journal.
    sync_directory(directory.path())
}

/// Syncs each file of the journal and writes the marker. The store is closed, and no sync of it has failed.
pub(super) fn mark_synced(directory: &Directory) -> io::Result<()> {
    for file in files(&directory.join(STORE))? {
        File::options().write(true).open(file)?.sync_all()?;
    }
    File::create(directory.join(MARKER))?.sync_all()?;
    sync_directory(directory.path())
}

/// The files of the journal in a store.
fn files(store: &Path) -> io::Result<Vec<PathBuf>> {
    let mut files = Vec::new();
    for file in fs::read_dir(store)? {
        let file = file?;
        if file.file_name().to_str().and_then(number).is_some() {
            files.push(file.path());
        }
    }
    Ok(files)
}

fn write_file_again(file: &mut File) -> io::Result<()> {
    let mut piece = vec![0; PIECE];
    let mut at = 0;
    loop {
        file.seek(SeekFrom::Start(at))?;
        let read = file.read(&mut piece)?;
        if read == 0 {
            return file.sync_all();
        }
        // The room that was taken in advance is a hole, and stays one.
        if piece[..read].iter().any(|&byte| byte != 0) {
            file.seek(SeekFrom::Start(at))?;
            file.write_all(&piece[..read])?;
        }
        at += read as u64;
    }
}

/// Whether anything was written to a file of the journal, which is made full of zeros: no entry begins with one.
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

    /// What the module says of fjall's files: a new version of fjall that does otherwise must not go unnoticed.
    #[test]
    fn what_was_committed_is_in_the_newest_file_once_it_is_synced() {
        let directory = tempfile::tempdir().unwrap();
        let store = Arc::new(Store::open(directory.path(), Durability::Fsync).unwrap());
        let mut journal = Journal::new(Arc::clone(&store), directory.path().into());
        let mut numbers = Vec::new();
        for round in 0..3u8 {
            let value = [b'a' + round; 100];
            let Handles { database, keyspace } = &*store.handles().unwrap();
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
            // Zeros: enough for fjall to begin another file when it moves them out.
            keyspace.insert("much", vec![0; 65_000_000]).unwrap();
            keyspace.rotate_memtable_and_wait().unwrap();
        }
        assert!(numbers.is_sorted_by(|a, b| a < b), "{numbers:?}");
    }

    #[test]
    fn only_after_a_clean_end_the_journal_is_not_written_again() {
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
            make_certain(&directory).unwrap();
            let modified = file.metadata().unwrap().modified().unwrap();
            assert_eq!(modified == long_ago, is_clean);
            assert_eq!(fs::read(&path).unwrap(), b"entries");
        }
    }

    /// What a rotation leaves that failed for want of room, while fjall writes on to the file before.
    #[test]
    fn a_file_that_was_made_and_is_not_written_to_does_not_hide_the_one_before() {
        let directory = tempfile::tempdir().unwrap();
        let store = Arc::new(Store::open(directory.path(), Durability::Fsync).unwrap());
        let mut journal = Journal::new(Arc::clone(&store), directory.path().into());
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
