//! Syncing the journal of the store without holding up who writes to it.
//!
//! `Database::persist` holds the journal's lock while the disk works, so writers would queue behind each sync instead
//! of sharing the next. So only what fjall still buffers is handed to the operating system under that lock, and the
//! file is synced here, through a handle of our own.
//!
//! This relies on how fjall 3 keeps its journal: files `N.jnl`, of which the one with the largest N is written to, and
//! the one before was synced before the next was made. Whatever was committed before [`Journal::sync`] is therefore in
//! the largest file that it finds, or synced already.

use std::{fs, fs::File, io, path::PathBuf, sync::Arc};

use fjall::PersistMode;

use super::store::{Store, told};

/// The journal of a store.
pub(super) struct Journal {
    store: Arc<Store>,
    directory: PathBuf,
    /// The newest file, by its number.
    newest: Option<(u64, File)>,
}

impl Journal {
    /// The journal of `store`, which lives in `directory`.
    pub(super) fn new(store: Arc<Store>, directory: PathBuf) -> Self {
        Self {
            store,
            directory,
            newest: None,
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
        match &mut self.newest {
            Some((known, file)) if *known == number => file.sync_data(),
            _ => {
                let file = File::options().write(true).open(self.file(number))?;
                file.sync_data()?;
                self.newest = Some((number, file));
                Ok(())
            }
        }
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
            let name = file?.file_name();
            let name = name.to_str().and_then(|name| name.strip_suffix(".jnl"));
            newest = newest.max(name.and_then(|name| name.parse::<u64>().ok()));
        }
        newest.ok_or_else(|| io::Error::other("it has no file"))
    }

    fn file(&self, number: u64) -> PathBuf {
        self.directory.join(format!("{number}.jnl"))
    }
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
}
