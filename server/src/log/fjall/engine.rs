//! The open store, with its threads and the state of its indices.

mod closing;

use std::{collections::BTreeMap, sync::Arc, time::Duration};

use parking_lot::{Mutex, RwLock};
use tracing::{debug, warn};

use super::{
    Durability, MARKS, STORE, StoreOptions,
    directory::Directory,
    failure::Failure,
    follow,
    index::{Index, State},
    journal::{self, StoreJournal},
    layout::{Number, Stage, StagedEntry, Sum, entry_key},
    manifest, manifest_copy,
    point_writer::FjallPointWriter,
    recovery,
    store::{Store, not_readable, shut, unopened},
    sweeper::Sweeper,
    sync_marks::{Mark, Marks},
    syncer::Syncer,
    torn_batch, unclean_marker,
};
use crate::log::{
    Entry, LogError, LostIndex, Origin, Receipt, Record, RecordPosition, RecordStream, Uid, View,
};

/// The time between two syncs of a store whose records another journal has. Three servers of a cluster that synced each
/// batch would take more of one machine's disk and processors than their journal.
const COPY_SYNC_INTERVAL: Duration = Duration::from_millis(100);

pub(super) struct Engine {
    syncer: Option<Syncer>,
    pub(super) sweeper: Sweeper,
    indexes: RwLock<BTreeMap<Uid, Arc<Index>>>,
    lost: Mutex<BTreeMap<Number, LostIndex>>,
    /// The number of the next index. Its lock serialises creating and deleting indices.
    next: Mutex<Number>,
    pub(super) failure: Arc<Failure>,
    pub(super) store: Arc<Store>,
    directory: Arc<Directory>,
}

impl Engine {
    /// Opens the existing store of a directory, or returns the error that prevents it.
    pub(super) fn open(
        directory: &Arc<Directory>,
        options: StoreOptions,
    ) -> Result<Self, LogError> {
        let durability = options.durability;
        let marks_path = directory.join(MARKS);
        let (mut marks, marked) = Marks::open(&marks_path).map_err(shut)?;
        let path = directory.join(STORE);
        if !path.try_exists().map_err(shut)? {
            return Err(not_readable(format!("there is no {}", path.display())));
        }
        manifest_copy::mend(directory)?;
        manifest::check(&path)?;
        journal::ensure_durable(directory).map_err(shut)?;
        let store = torn_batch::open(directory, options).map_err(unopened)?;
        let store = Arc::new(store);
        // Upgrade the format only after a successful open: if it fails, the server that wrote the directory can still open
        // it.
        directory.upgrade().map_err(shut)?;
        let may_have_lost = unclean_marker::may_have_lost(directory.path()).map_err(shut)?;
        let handles = store.handles()?;
        let found = recovery::recover(&handles, &marked, may_have_lost)?;
        drop(handles);
        // A server without fsync may have ended before it wrote the first mark.
        if marked.is_empty()
            && !found.indexes.is_empty()
            && !unclean_marker::was_begun(directory.path()).map_err(shut)?
        {
            warn!(
                file = %marks_path.display(),
                indexes = found.indexes.len(),
                "the file of the marks is missing or empty, so journal files that were cut short cannot be noticed; \
                 the indices get marks of their present revisions"
            );
        }
        let mut journal = StoreJournal::new(Arc::clone(&store), path);
        let failure = Arc::new(Failure::default());
        match journal.sync() {
            Ok(()) => {}
            // fjall has already met a damaged block. Everything found was synced above, so it can be read.
            Err(error @ LogError::StorageStopped) => {
                failure.note(error);
            }
            Err(LogError::Storage { what }) => return Err(LogError::Shut { what }),
            Err(error) => return Err(error),
        }
        unclean_marker::begin(directory.path(), durability).map_err(shut)?;
        save_manifest(directory);

        // Everything found is now on disk, acknowledged or not, so readers may rely on it.
        write_marks(&mut marks, &found.indexes).map_err(shut)?;
        let compacted = marks.compact(&marks_path, found.next, &found.used);
        let marks = compacted.map_err(shut)?;
        let (sweeping, _) = Marks::open(&marks_path).map_err(shut)?;
        let sweeper = Sweeper::start(Arc::clone(&store), sweeping, Arc::clone(&failure));
        let sweeper = sweeper.map_err(shut)?;
        let syncer = match durability {
            Durability::Fsync => {
                let failure = Arc::clone(&failure);
                let interval = match options.is_copy {
                    true => COPY_SYNC_INTERVAL,
                    false => Duration::ZERO,
                };
                Some(Syncer::start(journal, marks, failure, interval).map_err(shut)?)
            }
            Durability::Os | Durability::None => None,
        };
        for &number in &found.deleted {
            sweeper.sweep(number);
        }
        let indexes = found.indexes.into_iter();
        Ok(Self {
            syncer,
            sweeper,
            indexes: RwLock::new(indexes.map(|index| (index.entry.uid, index)).collect()),
            lost: Mutex::new(found.lost),
            next: Mutex::new(found.next),
            failure,
            store,
            directory: Arc::clone(directory),
        })
    }

    pub(super) fn index(&self, uid: Uid) -> Result<Arc<Index>, LogError> {
        match self.indexes.read().get(&uid) {
            Some(index) => Ok(Arc::clone(index)),
            None => Err(LogError::UnknownIndex { uid }),
        }
    }

    pub(super) fn entries(&self) -> Vec<Entry> {
        let indexes = self.indexes.read();
        indexes.values().map(|index| index.entry.clone()).collect()
    }

    pub(super) fn lost(&self) -> Vec<LostIndex> {
        self.lost.lock().values().cloned().collect()
    }

    fn writable(&self) -> Result<(), LogError> {
        match self.failure.get() {
            Some(why) => Err(why),
            None => Ok(()),
        }
    }

    /// Announces a batch that was committed.
    fn written(&self, index: &Arc<Index>, mark: Mark) {
        match &self.syncer {
            Some(syncer) => syncer.written(index, mark),
            None => index.set_durable(mark.revision),
        }
    }

    /// Waits until all that was announced is synced.
    fn wait(&self) -> Result<(), LogError> {
        match &self.syncer {
            Some(syncer) => syncer.wait(),
            None => Ok(()),
        }
    }

    /// Stores the entry of an index durably.
    fn put(&self, index: &Arc<Index>, stage: Stage, mark: Mark) -> Result<(), LogError> {
        self.writable()?;
        let handles = self.store.handles()?;
        let entry = index.entry.clone();
        let staged = StagedEntry { entry, stage }.encode(index.number);
        let mut batch = handles.database.batch();
        batch.insert(&handles.keyspace, entry_key(index.number), staged);
        let stored = handles.commit(batch);
        drop(handles);
        stored.map_err(|error| self.failure.note(error))?;
        self.written(index, mark);
        self.wait()
    }

    pub(super) fn create(&self, entry: Entry) -> Result<(), LogError> {
        let mut next = self.next.lock();
        self.check_uid_is_free(entry.uid)?;
        let number = *next;
        let index = Index::new(number, entry, State::new(Origin::START, Sum::default()));
        *next += 1;
        self.put(&index, Stage::Whole, index.head_mark())?;
        self.indexes.write().insert(index.entry.uid, index);
        Ok(())
    }

    pub(super) fn restore(
        self: Arc<Self>,
        entry: Entry,
        origin: Origin,
        replaces: bool,
    ) -> Result<FjallPointWriter, LogError> {
        match replaces {
            true => drop(self.index(entry.uid)?),
            false => self.check_uid_is_free(entry.uid)?,
        }
        self.writable()?;
        let mut next = self.next.lock();
        let number = *next;
        *next += 1;
        drop(next);
        FjallPointWriter::begin(self, number, entry, origin, replaces)
    }

    /// Puts a copy at the record `copied` in the place of the index with its uid. `write` completes the copy and marks the
    /// index as deleted, in one batch. If that fails, the next start decides.
    pub(super) fn swap_in(
        &self,
        uid: Uid,
        copied: RecordPosition,
        write: impl FnOnce(&Index) -> Result<Arc<Index>, LogError>,
    ) -> Result<(), LogError> {
        let _alone = self.next.lock();
        self.writable()?;
        let old = self.index(uid)?;
        let mark = Mark {
            deleted: true,
            ..old.supersede(copied)?
        };
        let swapped = write(&old).and_then(|index| {
            self.written(&old, mark);
            self.written(&index, index.head_mark());
            self.wait()?;
            Ok(index)
        });
        match swapped {
            Ok(index) => self.indexes.write().insert(uid, index),
            Err(why) => {
                old.close(why.clone());
                return Err(why);
            }
        };
        self.sweeper.sweep(old.number);
        Ok(())
    }

    /// Adds an index that is in the store, once it is durable there.
    pub(super) fn add(&self, index: Arc<Index>) -> Result<(), LogError> {
        self.written(&index, index.head_mark());
        self.wait()?;
        self.indexes.write().insert(index.entry.uid, index);
        Ok(())
    }

    fn check_uid_is_free(&self, uid: Uid) -> Result<(), LogError> {
        match self.indexes.read().contains_key(&uid) {
            true => Err(LogError::UidTaken { uid }),
            false => Ok(()),
        }
    }

    pub(super) fn delete(&self, uid: Uid) -> Result<(), LogError> {
        let _alone = self.next.lock();
        self.writable()?;
        if self.delete_lost(uid)? {
            return Ok(());
        }
        let index = self.index(uid)?;
        let mark = Mark {
            deleted: true,
            ..index.close(LogError::UnknownIndex { uid })
        };
        if let Err(why) = self.put(&index, Stage::Deleted, mark) {
            index.close(why.clone());
            return Err(why);
        }
        self.indexes.write().remove(&uid);
        self.sweeper.sweep(index.number);
        Ok(())
    }

    /// Marks a lost index as deleted, of which only the mark is left; false if the index is not lost.
    fn delete_lost(&self, uid: Uid) -> Result<bool, LogError> {
        let mut lost = self.lost.lock();
        let found = lost.iter().find(|(_, lost)| lost.uid == uid);
        let Some((&number, _)) = found else {
            return Ok(false);
        };
        let cleared = Marks::open(&self.directory.join(MARKS))
            .and_then(|(mut marks, _)| marks.delete(number));
        cleared.map_err(|error| LogError::Storage {
            what: error.to_string(),
        })?;
        lost.remove(&number);
        // If the entry could not be read, the other keys of the index may still exist.
        self.sweeper.sweep(number);
        Ok(true)
    }

    pub(super) fn submit(&self, uid: Uid, record: Arc<Record>) -> Result<Receipt, LogError> {
        self.writable()?;
        let index = self.index(uid)?;
        let submitted = index.submit(&self.store, record, |mark| self.written(&index, mark));
        submitted.map_err(|error| self.failure.note(error))?;
        Ok(Receipt::Accepted)
    }

    pub(super) fn apply(
        &self,
        uid: Uid,
        records: &[Arc<Record>],
    ) -> Result<Arc<dyn View>, LogError> {
        let index = self.index(uid)?;
        let view = index.apply(&self.store, records, |mark| self.written(&index, mark));
        view.map_err(|error| self.failure.note(error))
    }

    /// The newest revision of an index that is synced; None if nothing is.
    pub(super) fn durable(&self, uid: Uid) -> Result<Option<u64>, LogError> {
        let durable = self.index(uid)?.durable()?;
        Ok(self.syncer.as_ref().map(|_| durable))
    }

    pub(super) fn follow(&self, uid: Uid, after: u64) -> Result<RecordStream, LogError> {
        let index = self.index(uid)?;
        Ok(follow::follow(
            index,
            &self.store,
            self.failure.watch(),
            after,
        ))
    }
}

/// Saves the copy of the manifest. An error here does not fail the log: the copy only serves to repair later damage.
fn save_manifest(directory: &Directory) {
    if let Err(error) = manifest_copy::save(directory) {
        debug!(%error, "cannot copy the store's manifest");
    }
}

/// Marks these indices as synced up to their heads.
fn write_marks(marks: &mut Marks, indexes: &[Arc<Index>]) -> std::io::Result<()> {
    let heads = indexes
        .iter()
        .filter_map(|index| Some((index.number, index.mark()?)));
    let heads: Vec<_> = heads.collect();
    marks.write(heads.iter().map(|(number, mark)| (*number, mark)))
}
