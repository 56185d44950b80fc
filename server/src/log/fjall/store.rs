//! The store of a directory, which can be closed while others still know it.

use std::{io, path::Path, time::Duration};

use fjall::{Database, Keyspace, KeyspaceCreateOptions, LsmError, PersistMode};
use parking_lot::{MappedRwLockReadGuard, RwLock, RwLockReadGuard};

use super::Durability;
use crate::{
    log::{LogError, Uid},
    low_priority,
};

/// Most bytes of journal before the store moves points out of it: what a restart reads again at most.
const JOURNAL_BYTES: u64 = 128 * 1024 * 1024;

/// From this many on fjall holds whoever writes until it has moved them to its files, however long that takes, even
/// if it has failed to and never will.
const MEMTABLES_THAT_HALT: usize = 4;
const RUNS_THAT_STALL: usize = 20;

/// More than the files take of a store that holds next to nothing.
const SMALL_FILES: u64 = 1024 * 1024;

/// What is told of a failure of which fjall only says that there was one.
pub(super) const UNTOLD: &str = "an earlier failure to write";

/// How often to look whether the store has caught up, of which it gives no signal.
const CATCHING_UP: Duration = Duration::from_millis(2);

/// The store.
pub(super) struct Store(RwLock<Option<Handles>>);

/// The store, as long as it is open.
pub(super) struct Handles {
    pub(super) database: Database,
    /// All there is, as [`layout`](super::layout) describes it.
    pub(super) keyspace: Keyspace,
}

impl Store {
    /// Opens the store in a directory, or makes it there.
    pub(super) fn open(directory: &Path, durability: Durability) -> fjall::Result<Self> {
        // The threads that it starts yield as this one does. On files that it did not expect fjall may panic.
        let opened = low_priority::run("wayfold-open", || -> fjall::Result<Handles> {
            let database = Database::builder(directory)
                .max_journaling_size(JOURNAL_BYTES)
                // The syncer hands batches on to the operating system, or nobody does.
                .manual_journal_persist(durability != Durability::Os)
                .open()?;
            let keyspace = database.keyspace("wayfold", KeyspaceCreateOptions::default)?;
            Ok(Handles { database, keyspace })
        });
        let handles = opened.unwrap_or_else(|error| match error.raw_os_error() {
            // There was no thread to be had.
            Some(_) => Err(error.into()),
            None => Err(LsmError::Unrecoverable.into()),
        })?;
        Ok(Self(RwLock::new(Some(handles))))
    }

    /// The open store, which is not closed before what is returned is dropped. Not to be asked for twice at a time by
    /// one thread: one that closes it meanwhile would wait for the first, and the second for that one.
    pub(super) fn handles(&self) -> Result<MappedRwLockReadGuard<'_, Handles>, LogError> {
        RwLockReadGuard::try_map(self.0.read(), Option::as_ref).map_err(|_| LogError::Closed)
    }

    /// Closes it, once whoever uses it now is done, and gives up its files.
    pub(super) fn close(&self) {
        let handles = self.0.write().take();
        drop(handles);
    }
}

impl Handles {
    /// About how many bytes the store has yet to move out of its journal.
    pub(super) fn unmoved(&self) -> u64 {
        self.database.write_buffer_size()
    }

    /// Whether the next batch may have to wait: for the store to catch up, or for the disk, as fjall syncs the journal
    /// under its lock when it begins to move points out of it.
    pub(super) fn is_busy(&self) -> bool {
        self.keyspace.sealed_memtable_count() > 0
            || self.keyspace.l0_table_count() >= RUNS_THAT_STALL
    }

    /// About how many bytes a copy of it takes on disk at most.
    pub(super) fn room_for_copy(&self) -> u64 {
        let bytes = self.keyspace.disk_space() + self.unmoved();
        bytes + bytes.min(2 * JOURNAL_BYTES) + SMALL_FILES
    }

    /// Waits until the store has caught up so far that a batch does not wait inside, or says that it has failed.
    pub(super) fn wait_for_room(&self) -> Result<(), LogError> {
        while self.keyspace.sealed_memtable_count() + 1 >= MEMTABLES_THAT_HALT {
            // The only call that says whether it has failed without writing anything.
            self.database
                .persist(PersistMode::Buffer)
                .map_err(storage)?;
            std::thread::park_timeout(CATCHING_UP);
        }
        Ok(())
    }
}

/// A failure to write, or of a disk.
pub(super) fn storage(error: fjall::Error) -> LogError {
    LogError::Storage { what: told(error) }
}

/// A failure to read what belongs to an index: a disk that does not answer, or what it answers is not what was stored.
pub(super) fn unreadable(uid: Uid, error: fjall::Error) -> LogError {
    match damage(error) {
        Ok(what) => damaged_index(uid, &what),
        Err(error) => error,
    }
}

/// An index of which a block is damaged.
pub(super) fn damaged_index(uid: Uid, damage: &str) -> LogError {
    let what = format!("{damage}: first stop the server and run `wayfold-server repair`");
    LogError::Unreadable { uid, what }
}

/// What is damaged, where something could not be read; a disk that does not answer is an error.
pub(super) fn damage(error: fjall::Error) -> Result<String, LogError> {
    match error {
        fjall::Error::Io(_) | fjall::Error::Poisoned | fjall::Error::Storage(LsmError::Io(_)) => {
            Err(storage(error))
        }
        error => Ok(told(error)),
    }
}

/// Why the store as a whole cannot be opened: a disk that does not let it, or what is there is not what was stored.
pub(super) fn unopened(error: fjall::Error) -> LogError {
    match error {
        fjall::Error::Io(error) | fjall::Error::Storage(LsmError::Io(error)) => shut(error),
        fjall::Error::Poisoned => LogError::Shut { what: told(error) },
        error => not_readable(told(error)),
    }
}

/// As [`unopened`]. A file that is missing, ends too early, or stands where none should be is no trouble of the disk, nor
/// is an offset that no file has.
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

/// As [`unopened`], whatever the disk does.
pub(super) fn not_readable(what: String) -> LogError {
    LogError::Unopened { what, revision: 0 }
}

/// What the store says, in as few words as there are.
pub(super) fn told(error: fjall::Error) -> String {
    match error {
        fjall::Error::Io(error) | fjall::Error::Storage(LsmError::Io(error)) => error.to_string(),
        fjall::Error::Poisoned => UNTOLD.into(),
        error => error.to_string(),
    }
}
