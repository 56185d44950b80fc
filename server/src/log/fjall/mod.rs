//! A log on disk, in the embedded store fjall.
//!
//! A mutation is one atomic batch of the store: its record, the points that it changes, and the head of its index.
//! [`Durability`] decides what an acknowledged mutation survives. Under `fsync`, all concurrent writers share one sync
//! (`syncer`).
//!
//! Modules: `options` (the settings), `directory` (ownership and lock of the data directory), `engine` and `store` (the
//! open store), `manifest` and `manifest_copy` (checks before it is opened), `layout` and `point` (keys and values,
//! byte for byte), `index` (the writer of one index), `follow` (its records as a stream), `view` (its points at one
//! revision), `point_writer` (an index made from a copy), `session` (the stored writer sessions), `journal`, `syncer`
//! and `sync_marks` (syncing, and the synced revisions), `failure` (the first failure, which stops all writing),
//! `recovery` (from the files to the state), `rebuild` (a new store, or one rebuilt from a damaged one), `torn_batch`
//! (a torn write at the end of the journal), `unclean_marker` (an unclean shutdown without fsync), `sweeper` (removal
//! of deleted indices), `usage` (the bytes of the files).
//!
//! A failed store takes no writes and still serves reads. [`PointStore::reopen`] closes it and opens it as a start
//! does: there is no other path from the files to the state. A damaged store serves what is readable; only [`repair`]
//! rebuilds it.

mod directory;
mod engine;
mod failure;
mod follow;
#[cfg(any(fuzzing, test))]
pub mod fuzzing;
mod index;
mod journal;
mod layout;
mod manifest;
mod manifest_copy;
mod options;
mod point;
mod point_writer;
mod rebuild;
mod recovery;
mod session;
mod store;
mod sweeper;
mod sync_marks;
mod syncer;
mod torn_batch;
mod unclean_marker;
mod usage;
mod view;

use std::{
    io, mem,
    path::Path,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering::Relaxed},
    },
};

use futures_util::{StreamExt, stream};
use parking_lot::{Mutex, RwLock};
use tracing::{error, info};

pub use directory::OpenError;
pub(crate) use directory::make_directory;
pub use options::{Durability, StoreOptions};
pub use rebuild::{RepairError, RepairReport, repair};
pub(crate) use syncer::SYNCS;

use super::{
    Catalogue, Entry, Journal, LogError, LostIndex, Operation, Origin, PointStore, PointVisitor,
    PointWriter, Receipt, Record, RecordStream, Retention, StoreUsage, Uid, View, Window,
};
use directory::Directory;
use engine::Engine;
use store::shut;
use sync_marks::{Mark, Marks};

const STORE: &str = "store";
/// A store that is being made; it is renamed once it is whole.
const NEW_STORE: &str = "store.new";
/// A rebuilt store that has yet to replace the damaged one.
const REBUILT_STORE: &str = "store.rebuilt";
/// The prefix of damaged stores as they were before a repair; a number follows.
const DAMAGED_STORE: &str = "store.damaged-";
const MARKS: &str = "marks";

/// A log in a directory: journal, points and catalogue.
///
/// Closing or dropping it syncs all appended records and closes its views.
pub struct FjallLog {
    /// The open store, or the error of every call. Dropped before the directory is unlocked.
    opened: RwLock<Result<Arc<Engine>, LogError>>,
    /// Held while the store is reopened or closed.
    reopening: Mutex<()>,
    /// True once it is closed for good, or about to be: reads of all points end early, and it is not reopened.
    is_closed: AtomicBool,
    options: StoreOptions,
    directory: Arc<Directory>,
}

impl FjallLog {
    /// Opens the log in `directory`, and creates the directory if it is missing.
    ///
    /// A store that cannot be read is not an error here: a supervisor would restart the server forever. Instead, every
    /// call fails with the cause, and [`Catalogue::lost`] names the indices.
    pub fn open(directory: &Path, options: impl Into<StoreOptions>) -> Result<Self, OpenError> {
        let directory = Arc::new(Directory::take(directory)?);
        let failed = |path: &Path, source| OpenError::Io {
            path: path.into(),
            source,
        };
        rebuild::finish(&directory)
            .and_then(|_| rebuild::make_first(&directory))
            .map_err(|source| failed(directory.path(), source))?;
        let marks = directory.join(MARKS);
        Marks::open(&marks).map_err(|source| failed(&marks, source))?;
        let options = options.into();
        let opened = Engine::open(&directory, options);
        let path = directory.path().display();
        match &opened {
            Ok(_) => info!(directory = %path, "opened the log"),
            Err(why) => {
                error!(directory = %path, error = %why, "the log cannot be opened: every call fails");
            }
        }
        Ok(Self {
            opened: RwLock::new(opened.map(Arc::new)),
            reopening: Mutex::default(),
            is_closed: AtomicBool::default(),
            options,
            directory,
        })
    }

    /// Opens the log in a directory that has one: a mistyped name makes no directory.
    pub(crate) fn open_existing(
        directory: &Path,
        options: impl Into<StoreOptions>,
    ) -> Result<Self, OpenError> {
        directory::require_store(directory)?;
        Self::open(directory, options)
    }

    fn engine(&self) -> Result<Arc<Engine>, LogError> {
        self.opened.read().clone()
    }

    /// Fails if the disk would prevent the store from being reopened. `failed` is the store, if it is still open.
    fn probe(&self, failed: Option<&Engine>) -> Result<(), LogError> {
        let disk_error = |error: io::Error| match failed {
            Some(_) => LogError::Storage {
                what: error.to_string(),
            },
            None => shut(error),
        };
        let handles = failed.and_then(|failed| failed.store.handles().ok());
        // Opening removes what a merge had written when the disk was full, so the probe would fail until then. It moves the
        // unflushed bytes to the tables next, and fails if it cannot.
        let (unflushed, freed) = handles.map_or((0, 0), |handles| {
            let written = usage::disk(self.directory.path()).tables;
            let freed = written.saturating_sub(handles.keyspace.disk_space());
            (handles.unflushed_bytes(), freed)
        });
        self.directory
            .probe(STORE, unflushed, freed)
            .map_err(disk_error)
    }

    /// Opens the store after `failure`. fjall does not report whether it met a damaged block, so the whole store is
    /// read. A damaged store is open for reading only.
    fn open_after(&self, failure: &LogError) -> Result<Engine, LogError> {
        let engine = Engine::open(&self.directory, self.options)?;
        if *failure == LogError::StorageStopped {
            let damage = engine.store.handles();
            match damage.and_then(|handles| rebuild::find_damage(&handles)) {
                Ok(None) => {}
                Ok(Some(what)) => {
                    let damaged = LogError::DamagedStore { what };
                    engine.failure.note(damaged.clone());
                    // fjall may have met the damage while it opened the store.
                    engine.failure.explain(&damaged);
                }
                Err(why) => {
                    engine.shut();
                    return Err(why);
                }
            }
        }
        Ok(engine)
    }

    /// Syncs the applied records and closes the store for good: every later call fails. An orderly stop closes it while
    /// others still hold it. Blocks.
    pub fn close(&self) {
        self.is_closed.store(true, Relaxed);
        let _alone = self.reopening.lock();
        if let Ok(engine) = mem::replace(&mut *self.opened.write(), Err(LogError::Closed)) {
            engine.shut();
        }
    }
}

impl Drop for FjallLog {
    fn drop(&mut self) {
        self.close();
    }
}

impl Journal for FjallLog {
    fn submit(&self, uid: Uid, record: Arc<Record>) -> Result<Receipt, LogError> {
        self.engine()?.submit(uid, record)
    }

    fn follow(&self, uid: Uid, after: u64) -> RecordStream {
        let followed = self.engine().and_then(|engine| engine.follow(uid, after));
        followed.unwrap_or_else(|error| stream::once(async { Err(error) }).boxed())
    }

    fn read(
        &self,
        uid: Uid,
        after: Option<u64>,
        max_bytes: usize,
    ) -> Result<Vec<Arc<Record>>, LogError> {
        let engine = self.engine()?;
        engine.index(uid)?.read(&engine.store, after, max_bytes)
    }

    fn newest(&self, uid: Uid) -> Result<u64, LogError> {
        Ok(self.view(uid)?.revision())
    }

    fn is_busy(&self) -> bool {
        self.engine().is_ok_and(|engine| {
            let handles = engine.store.handles();
            handles.is_ok_and(|handles| handles.is_busy())
        })
    }
}

impl PointStore for FjallLog {
    fn apply(&self, uid: Uid, records: &[Arc<Record>]) -> Result<Arc<dyn View>, LogError> {
        self.engine()?.apply(uid, records)
    }

    fn view(&self, uid: Uid) -> Result<Arc<dyn View>, LogError> {
        let engine = self.engine()?;
        engine.index(uid)?.pin(&engine.store)
    }

    fn load(&self, uid: Uid, visit: &mut PointVisitor<'_>) -> Result<Arc<dyn View>, LogError> {
        let engine = self.engine()?;
        let visit = &mut |point: &_| match self.is_closed.load(Relaxed) {
            true => Err(LogError::Closed),
            false => visit(point),
        };
        let loaded = engine.index(uid)?.load(&engine.store, visit);
        // A disk that fails while an index is loaded has failed: the store is reopened, and the index loaded again.
        loaded.map_err(|error| engine.failure.note(error))
    }

    fn trim(&self, uid: Uid, retention: &Retention) -> Result<(), LogError> {
        self.engine()?.index(uid)?.trim(retention)
    }

    fn window(&self, uid: Uid) -> Result<Window, LogError> {
        Ok(self.engine()?.index(uid)?.window())
    }

    fn operations(&self, uid: Uid) -> Result<Vec<Arc<Operation>>, LogError> {
        let engine = self.engine()?;
        engine.index(uid)?.operations(&engine.store)
    }

    fn durable(&self, uid: Uid) -> Result<Option<u64>, LogError> {
        self.engine()?.durable(uid)
    }

    fn restore(
        &self,
        entry: Entry,
        origin: Origin,
        replaces: bool,
    ) -> Result<Box<dyn PointWriter>, LogError> {
        Ok(Box::new(self.engine()?.restore(entry, origin, replaces)?))
    }

    fn failure(&self) -> Option<LogError> {
        match self.engine() {
            Ok(engine) => engine.failure.get(),
            Err(error) => Some(error),
        }
    }

    fn usage(&self) -> StoreUsage {
        let engine = self.engine();
        let memory = engine.and_then(|engine| Ok(engine.store.handles()?.memory()));
        StoreUsage {
            memory: memory.unwrap_or(0),
            ..usage::disk(self.directory.path())
        }
    }

    fn reopen(&self) -> Result<(), LogError> {
        let _alone = self.reopening.lock();
        if self.is_closed.load(Relaxed) {
            return Err(LogError::Closed);
        }
        let Some(failure) = self.failure() else {
            return Ok(());
        };
        if matches!(failure, LogError::DamagedStore { .. }) {
            return Err(failure);
        }
        // The failed store still serves reads, so it stays open until the disk can be written.
        let failed = self.engine().ok();
        if let Err(why) = self.probe(failed.as_deref()) {
            if let Some(failed) = failed {
                failed.failure.explain(&why);
            }
            return Err(why);
        }
        if let Some(failed) = failed {
            *self.opened.write() = Err(LogError::Closed);
            failed.shut();
        }
        let opened = self.open_after(&failure).map(Arc::new);
        self.opened.write().clone_from(&opened);
        opened?;
        info!("reopened the log");
        Ok(())
    }
}

impl Catalogue for FjallLog {
    fn indexes(&self) -> Result<Vec<Entry>, LogError> {
        match self.engine() {
            Ok(engine) => Ok(engine.entries()),
            // The indices of an unopened store are listed as lost instead.
            Err(LogError::Unopened { .. } | LogError::Shut { .. }) => Ok(Vec::new()),
            Err(error) => Err(error),
        }
    }

    fn lost(&self) -> Vec<LostIndex> {
        let why = match self.engine() {
            Ok(engine) => return engine.lost(),
            Err(LogError::Closed) => return Vec::new(),
            Err(why) => why,
        };
        let marked = Marks::open(&self.directory.join(MARKS)).map(|(_, marked)| marked);
        let marked = marked.unwrap_or_default();
        let lost = marked.live().map(|(_, mark)| LostIndex {
            name: mark.name.to_string(),
            uid: mark.uid,
            why: lost_error(&why, mark),
        });
        lost.collect()
    }

    fn create(&self, entry: Entry) -> Result<(), LogError> {
        self.engine()?.create(entry)
    }

    fn delete(&self, uid: Uid) -> Result<(), LogError> {
        self.engine()?.delete(uid)
    }
}

/// The error of an index in a store that cannot be opened.
fn lost_error(why: &LogError, mark: &Mark) -> LogError {
    match why {
        LogError::Unopened { what, .. } => LogError::Unopened {
            what: what.clone(),
            revision: mark.revision,
        },
        why => why.clone(),
    }
}
