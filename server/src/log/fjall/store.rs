//! The store of a directory. It can be closed while others still hold a reference to it.

use std::{io, path::Path, sync::Arc, time::Duration};

use fjall::{
    AbstractTree, Database, Keyspace, KeyspaceCreateOptions, LsmError, OwnedWriteBatch,
    PersistMode, compaction::Leveled,
};
use parking_lot::{MappedRwLockReadGuard, Mutex, MutexGuard, RwLock, RwLockReadGuard};

use super::{Durability, StoreOptions};
use crate::{
    log::{LogError, Uid},
    low_priority,
};

/// The maximum bytes of the journal, above which the store moves points out of it. A restart reads at most this many
/// bytes again.
const JOURNAL_BYTES: u64 = 128 * 1024 * 1024;

/// From this many sealed memtables on, fjall blocks writers until it has moved some to its files, and from this many
/// runs in level 0 on, until it has merged some. It blocks them forever if the move or the merge has failed.
const MIN_HALTING_MEMTABLES: usize = 4;
const MIN_HALTING_RUNS: usize = 30;

/// The maximum number of memtables that fjall seals while one batch is committed: the one before the batch, and the one
/// with it. fjall does not seal an empty memtable.
const MAX_SEALED_BY_BATCH: usize = 2;

/// From this many tables in level 0 on, the next batch may wait for the store.
const MIN_STALLING_RUNS: usize = 20;

/// The bytes of the cache of read blocks, and of a memtable, unless [`MEMORY_SHARE`] allows fewer. With fjall's 64 MiB a
/// load of a million points holds half as much memory again.
const CACHE_BYTES: u64 = 32 * 1024 * 1024;
const MEMTABLE_BYTES: u64 = 32 * 1024 * 1024;

/// The tables in level 0 from which fjall merges them. Twice fjall's own number of tables of half the size: a load
/// writes as many bytes as with fjall's own settings, and a quarter more with fjall's number.
const LEVEL_0_TABLES: u8 = 8;

/// The bytes of a memtable of a store that was made with fjall's own settings, which fjall keeps.
const MAX_MEMTABLE_BYTES: u64 = 64 * 1024 * 1024;

/// The cache, and each of the memtables, get at most this part of the memory of the server.
const MEMORY_SHARE: u64 = 16;

/// An upper bound on the size of a nearly empty store.
const SMALL_STORE_BYTES: u64 = 1024 * 1024;

/// The store does not signal that it has caught up: it is polled at this interval.
const POLL_INTERVAL: Duration = Duration::from_millis(2);

pub(super) struct Store(RwLock<Option<Handles>>);

/// The handles of an open store.
pub(super) struct Handles {
    pub(super) database: Database,
    /// The only keyspace; [`layout`](super::layout) describes its content.
    pub(super) keyspace: Keyspace,
    /// The bytes of a memtable.
    memtable_bytes: u64,
    /// Held while a batch is committed. The holder locks nothing else of this crate.
    committing: Mutex<()>,
}

impl Store {
    /// Opens the store in a directory, or creates it.
    pub(super) fn open(directory: &Path, options: impl Into<StoreOptions>) -> fjall::Result<Self> {
        let options = options.into();
        let share = options.memory / MEMORY_SHARE;
        let is_write_through = match options.durability {
            // The syncer writes the batches to the operating system, but at an interval for a copy.
            Durability::Fsync => options.is_copy,
            Durability::Os => true,
            Durability::None => false,
        };
        // The threads that fjall starts inherit this one's low priority. fjall may panic on unexpected files.
        let opened = low_priority::run("wayfold-open", || -> fjall::Result<Handles> {
            let database = Database::builder(directory)
                .max_journaling_size(JOURNAL_BYTES)
                .cache_size(share.min(CACHE_BYTES))
                .manual_journal_persist(!is_write_through)
                .open()?;
            let keyspace = database.keyspace("wayfold", || {
                let levels = Leveled::default()
                    .with_l0_threshold(LEVEL_0_TABLES)
                    .with_table_target_size(MEMTABLE_BYTES);
                KeyspaceCreateOptions::default()
                    .max_memtable_size(MEMTABLE_BYTES)
                    .compaction_strategy(Arc::new(levels))
            })?;
            Ok(Handles {
                database,
                keyspace,
                memtable_bytes: share.min(MAX_MEMTABLE_BYTES),
                committing: Mutex::default(),
            })
        });
        let handles = opened.unwrap_or_else(|error| match error.raw_os_error() {
            // The thread could not be started.
            Some(_) => Err(error.into()),
            None => Err(LsmError::Unrecoverable.into()),
        })?;
        Ok(Self(RwLock::new(Some(handles))))
    }

    /// The open store. It is not closed before the returned guard is dropped. A thread must not hold two guards: a
    /// thread that closes the store would wait for the first guard, and the second call would wait for that thread.
    pub(super) fn handles(&self) -> Result<MappedRwLockReadGuard<'_, Handles>, LogError> {
        RwLockReadGuard::try_map(self.0.read(), Option::as_ref).map_err(|_| LogError::Closed)
    }

    /// Syncs the journal and closes the store and its files, once no guard is held. It closes them even if the sync
    /// fails, as it does after any failure of the store.
    pub(super) fn close(&self) -> Result<(), LogError> {
        let Some(handles) = self.0.write().take() else {
            return Ok(());
        };
        // fjall syncs the journal as it closes, but does not report a failure.
        let synced = handles.database.persist(PersistMode::SyncAll);
        synced.map_err(storage)
    }
}

impl Handles {
    /// The approximate number of bytes that the store has yet to move out of its journal.
    pub(super) fn unflushed_bytes(&self) -> u64 {
        self.database.write_buffer_size()
    }

    /// The bytes of its memory: its cache and its memtables.
    pub(super) fn memory(&self) -> u64 {
        self.database.cache_size() + self.unflushed_bytes()
    }

    /// True if the next batch may have to wait for the store to catch up, or for the disk: fjall syncs the journal
    /// under its lock when it begins to move points out of it.
    pub(super) fn is_busy(&self) -> bool {
        self.keyspace.sealed_memtable_count() > 0
            || self.keyspace.l0_table_count() >= MIN_STALLING_RUNS
    }

    /// An approximate upper bound on the disk space of a copy.
    pub(super) fn room_for_copy(&self) -> u64 {
        let bytes = self.keyspace.disk_space() + self.unflushed_bytes();
        bytes + bytes.min(2 * JOURNAL_BYTES) + SMALL_STORE_BYTES
    }

    /// Commits a batch once there is room for it.
    pub(super) fn commit(&self, batch: OwnedWriteBatch) -> Result<(), LogError> {
        let _room = self.wait_for_room()?;
        batch.commit().map_err(storage)
    }

    /// Waits until the store has caught up so far that a batch does not block inside fjall. The room is for one batch:
    /// other writers wait until the guard is dropped. Fails if the store has failed.
    pub(super) fn wait_for_room(&self) -> Result<MutexGuard<'_, ()>, LogError> {
        let room = self.committing.lock();
        // A size below the one that the store was made with is enforced here.
        let sealed = self.keyspace.sealed_memtable_count() as u64;
        if self.memtable_bytes < MAX_MEMTABLE_BYTES
            && self.unflushed_bytes() > (sealed + 1) * self.memtable_bytes
        {
            self.keyspace.rotate_memtable().map_err(storage)?;
        }
        while !self.has_room() {
            // This is the only call that reports a failure without writing anything.
            self.database
                .persist(PersistMode::Buffer)
                .map_err(storage)?;
            std::thread::park_timeout(POLL_INTERVAL);
        }
        Ok(room)
    }

    /// True if one batch does not block inside fjall, whatever fjall seals and moves meanwhile.
    fn has_room(&self) -> bool {
        // They are read before the runs: a memtable that becomes a run in between counts twice, and is not missed.
        let sealed = self.keyspace.sealed_memtable_count() + MAX_SEALED_BY_BATCH;
        sealed < MIN_HALTING_MEMTABLES
            && sealed + self.keyspace.tree.l0_run_count() < MIN_HALTING_RUNS
    }
}

/// The error of a failed write or a failed disk.
pub(super) fn storage(error: fjall::Error) -> LogError {
    match error {
        fjall::Error::Poisoned => LogError::StorageStopped,
        error => LogError::Storage { what: text(error) },
    }
}

/// The error of a failed read of an index's data: the disk failed, or its bytes differ from the stored ones.
pub(super) fn unreadable(uid: Uid, error: fjall::Error) -> LogError {
    match damage(error) {
        Ok(what) => damaged_index(uid, &what),
        Err(error) => error,
    }
}

/// The error of an index with a damaged block.
pub(super) fn damaged_index(uid: Uid, damage: &str) -> LogError {
    let what = format!("{damage}: first stop the server and run `wayfold-server repair`");
    LogError::Unreadable { uid, what }
}

/// The damage behind a failed read; a disk that does not answer is an error.
pub(super) fn damage(error: fjall::Error) -> Result<String, LogError> {
    match error {
        fjall::Error::Io(_) | fjall::Error::Poisoned | fjall::Error::Storage(LsmError::Io(_)) => {
            Err(storage(error))
        }
        error => Ok(text(error)),
    }
}

/// The error of a store that cannot be opened: the disk failed, or its bytes differ from the stored ones.
pub(super) fn unopened(error: fjall::Error) -> LogError {
    match error {
        fjall::Error::Io(error) | fjall::Error::Storage(LsmError::Io(error)) => shut(error),
        error @ fjall::Error::Poisoned => LogError::Shut { what: text(error) },
        error => not_readable(text(error)),
    }
}

/// Like [`unopened`]. A file that is missing, truncated or unexpected is not an error of the disk, nor is an invalid
/// offset.
pub(super) fn shut(error: io::Error) -> LogError {
    use io::ErrorKind::{
        AlreadyExists, DirectoryNotEmpty, InvalidInput, IsADirectory, NotADirectory, NotFound,
        StorageFull,
    };
    let what = error.to_string();
    match (error.raw_os_error(), error.kind()) {
        (_, StorageFull) => LogError::Shut { what },
        (None, _)
        | (
            Some(_),
            AlreadyExists | DirectoryNotEmpty | InvalidInput | IsADirectory | NotADirectory
            | NotFound,
        ) => not_readable(what),
        (Some(_), _) => LogError::Shut { what },
    }
}

/// Like [`unopened`], for damage that is not an error of the disk.
pub(super) fn not_readable(what: String) -> LogError {
    LogError::Unopened { what, revision: 0 }
}

/// The store's error as a short text.
fn text(error: fjall::Error) -> String {
    match error {
        fjall::Error::Io(error) | fjall::Error::Storage(LsmError::Io(error)) => error.to_string(),
        error => error.to_string(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The store seals two memtables and fails to move them: fjall might seal two more for a batch, and would block it.
    #[test]
    fn a_batch_without_room_fails_with_the_store() {
        let directory = tempfile::tempdir().unwrap();
        let store = Store::open(directory.path(), Durability::Fsync).unwrap();
        let handles = store.handles().unwrap();
        let keyspace = &handles.keyspace;
        std::fs::remove_dir_all(keyspace.path().join("tables")).unwrap();
        // The moves wait until both memtables are sealed.
        let flush = keyspace.tree.get_flush_lock();
        for key in [[0u8], [1]] {
            drop(handles.wait_for_room().unwrap());
            keyspace.insert(key, "value").unwrap();
            assert!(keyspace.rotate_memtable().unwrap());
        }
        drop(flush);
        let refused = handles.wait_for_room().err();
        assert_eq!(refused, Some(LogError::StorageStopped));
        drop(handles);
        assert_eq!(store.close(), Err(LogError::StorageStopped));
    }
}
