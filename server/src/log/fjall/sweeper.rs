//! Removes the keys of deleted indices on a separate thread: removing millions of points takes long.

use std::{
    fmt::Display,
    ops::Bound,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
        mpsc,
    },
    thread::JoinHandle,
};

use fjall::{AbstractTree, OwnedWriteBatch, PersistMode};
use parking_lot::Mutex;
use tracing::warn;

use super::{
    failure::Failure,
    layout::{
        Number, block_key, entry_key, head_key, operation_key, point_key, record_key, session_key,
    },
    store::{Handles, Store, storage},
    sync_marks::Marks,
};
use crate::log::LogError;

/// The number of keys that are removed in one batch. Other writers write between the batches.
const BATCH_KEYS: usize = 1024;

/// A range of keys of one kind.
type KeyRange = (Bound<[u8; 13]>, Bound<[u8; 13]>);

pub(super) struct Sweeper {
    deleted: Mutex<Option<mpsc::Sender<Number>>>,
    stop: Arc<AtomicBool>,
    thread: Mutex<Option<JoinHandle<()>>>,
}

impl Sweeper {
    pub(super) fn start(
        store: Arc<Store>,
        mut marks: Marks,
        failure: Arc<Failure>,
    ) -> std::io::Result<Self> {
        let (deleted, work) = mpsc::channel();
        let stop = Arc::new(AtomicBool::new(false));
        let stopped = Arc::clone(&stop);
        let thread = std::thread::Builder::new()
            .name("wayfold-sweep".into())
            .spawn(move || {
                for number in work {
                    if let Err(error) = sweep(&store, &failure, number, &mut marks, &stopped) {
                        warn!(
                            number,
                            error, "cannot remove what is left of a deleted index"
                        );
                    }
                }
            })?;
        Ok(Self {
            deleted: Mutex::new(Some(deleted)),
            stop,
            thread: Mutex::new(Some(thread)),
        })
    }

    pub(super) fn stop(&self) {
        self.stop.store(true, Ordering::Relaxed);
        *self.deleted.lock() = None;
        if let Some(thread) = self.thread.lock().take() {
            // The thread panics only by a bug, and the panic hook has printed it.
            let _ = thread.join();
        }
    }

    /// Queues a deleted index for removal. A later start continues a removal that is unfinished when the server ends.
    pub(super) fn sweep(&self, number: Number) {
        if let Some(deleted) = &*self.deleted.lock() {
            // The send fails only if the thread has panicked.
            let _ = deleted.send(number);
        }
    }
}

impl Drop for Sweeper {
    fn drop(&mut self) {
        self.stop();
    }
}

fn sweep(
    store: &Store,
    failure: &Failure,
    number: Number,
    marks: &mut Marks,
    stop: &AtomicBool,
) -> Result<(), String> {
    if stop.load(Ordering::Relaxed) {
        return Ok(());
    }
    let has_dropped = drop_tables(store, failure, number).map_err(text)?;
    for key in [point_key, record_key, operation_key, session_key, block_key] {
        let mut after = Bound::Included(key(number, 0));
        let last = Bound::Included(key(number, u64::MAX));
        while let Some(removed) = remove_some(store, failure, (after, last)).map_err(text)? {
            // Continues after the last removed key: from the start, the scan would pass every removed key again.
            after = Bound::Excluded(removed);
            if stop.load(Ordering::Relaxed) {
                return Ok(());
            }
        }
    }
    // The mark is written before the entry is removed: a live mark without an entry means a lost index.
    marks.delete(number).map_err(text)?;
    let handles = store.handles().map_err(text)?;
    let mut batch = handles.database.batch();
    batch.remove(&handles.keyspace, entry_key(number));
    batch.remove(&handles.keyspace, head_key(number));
    commit(&handles, batch, failure).map_err(text)?;
    if has_dropped {
        // The dropped files stay until the store lets go of its former lists of tables, which an idle one never does.
        handles.keyspace.rotate_memtable().map_err(text)?;
    }
    Ok(())
}

/// Drops the tables that hold nothing but points or records of the index, and returns whether there were any: those that a
/// merge has made. Removed keys alone give no disk back before the store merges their tables, for which it needs more disk.
/// Comes before the removal of keys, whose marks might be in a dropped table while the values are in another.
fn drop_tables(store: &Store, failure: &Failure, number: Number) -> Result<bool, LogError> {
    let handles = store.handles()?;
    let tree = &handles.keyspace.tree;
    let mut has_dropped = false;
    for key in [point_key, record_key] {
        let (first, last) = (key(number, 0), key(number, u64::MAX));
        // Without any, the call would write a list of tables all the same.
        let version = tree.current_version();
        let mut ranges = version.iter_tables().map(|table| &table.metadata.key_range);
        if ranges.any(|it| first[..] <= **it.min() && **it.max() <= last[..]) {
            // A loss of power must not bring an index back whose tables are gone.
            let is_synced = handles.database.persist(PersistMode::SyncAll);
            is_synced.map_err(|error| failure.note(storage(error)))?;
            let dropped = tree.drop_range(first..=last);
            dropped.map_err(|error| storage(error.into()))?;
            has_dropped = true;
        }
    }
    Ok(has_dropped)
}

/// Commits a batch. A failure here stops all writers, so the cause is noted for them too.
fn commit(handles: &Handles, batch: OwnedWriteBatch, failure: &Failure) -> Result<(), LogError> {
    let committed = handles.commit(batch);
    committed.map_err(|error| failure.note(error))
}

fn text(error: impl Display) -> String {
    error.to_string()
}

/// Removes the first few keys of a range and returns the last of them; None if the range is empty.
fn remove_some(
    store: &Store,
    failure: &Failure,
    range: KeyRange,
) -> Result<Option<[u8; 13]>, LogError> {
    let handles = store.handles()?;
    let mut batch = handles.database.batch();
    let mut last = None;
    for found in handles.keyspace.range(range).take(BATCH_KEYS) {
        let key = found.key().map_err(storage)?;
        last = key.first_chunk().copied();
        batch.remove(&handles.keyspace, key);
    }
    commit(&handles, batch, failure)?;
    Ok(last)
}
