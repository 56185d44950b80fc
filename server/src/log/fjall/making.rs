//! How a store comes to be: with nothing in it, or from one that is damaged, with all that can be read of it.
//!
//! fjall rewrites its files by and by, with whatever is written. Where it comes upon a block then that is not what it
//! wrote, it stops writing for good, and so it would for all indices and at every start anew. So a store of which a
//! block cannot be read is made anew: indices that can be read whole are copied key by key, of others the entry is left,
//! which says so. The damaged store stays beside it.
//!
//! A store in the making takes its name once it is whole and synced; a start that finds it so goes on from there
//! ([`finish`]).

use std::{fs, io, sync::Arc};

use fjall::{Guard, OwnedWriteBatch, Slice};
use tracing::{error, info, warn};

use super::{
    DAMAGED_STORE, Durability, MARKS, NEW_STORE, REMADE_STORE, STORE,
    directory::{Directory, sync_directories, sync_directory},
    journal::Journal,
    layout::{
        Named, Number, Stage, head_key, number_of_entry, operation_key, point_key, record_key,
    },
    recovery::entries,
    store::{Handles, Store, damage, not_readable, shut, storage, unopened},
};
use crate::log::LogError;

/// About how many bytes are copied in one batch.
const BATCH_BYTES: usize = 1024 * 1024;

/// Makes the store, unless there is one, or was: beside the file of marks, one that is missing is not to be taken for
/// one that holds nothing. A start that is cut short leaves none, or a whole one.
pub(super) fn make_first(directory: &Directory) -> io::Result<()> {
    let store = directory.join(STORE);
    if store.try_exists()? || directory.join(MARKS).try_exists()? {
        return Ok(());
    }
    make(directory, |_| Ok(())).map_err(io::Error::other)?;
    fs::rename(directory.join(NEW_STORE), &store)?;
    fs::File::options()
        .append(true)
        .create(true)
        .open(directory.join(MARKS))?;
    sync_directory(directory.path())
}

/// Makes a store beside the one that is there, durable with all that `fill` writes to it.
fn make(
    directory: &Directory,
    fill: impl FnOnce(&Handles) -> Result<(), LogError>,
) -> Result<(), LogError> {
    let new = directory.join(NEW_STORE);
    if new.try_exists().map_err(shut)? {
        fs::remove_dir_all(&new).map_err(shut)?;
    }
    let made = Arc::new(Store::open(&new, Durability::Fsync).map_err(unopened)?);
    fill(&*made.handles()?)?;
    let synced = Journal::new(Arc::clone(&made), new.clone()).sync();
    synced.map_err(|what| LogError::Storage { what })?;
    made.close();
    // fjall leaves it to the file system whether the names of its directories are durable.
    sync_directories(&new).map_err(shut)
}

/// What came of a store that may be damaged.
pub(super) enum Remade {
    /// Every block of it can be read.
    Whole,
    /// It was made anew.
    Anew,
    /// It is damaged, and for a new one so many bytes would have to be free.
    NoRoom(u64),
}

/// How many bytes must be free for a store to be made anew, if it is damaged and fewer are.
pub(super) fn missing_room(directory: &Directory, store: &Store) -> Result<Option<u64>, LogError> {
    let handles = store.handles()?;
    let needed = handles.room_for_copy();
    if directory.room().map_err(shut)? >= needed {
        return Ok(None);
    }
    let damage = damage_in(handles.keyspace.iter())?;
    Ok(damage.map(|damage| {
        error!(damage, needed, "no room to make the store anew");
        needed
    }))
}

/// Reads a store, which is closed, from end to end, and makes it anew if it is damaged.
pub(super) fn remake(directory: &Directory) -> Result<Remade, LogError> {
    let old = Store::open(&directory.join(STORE), Durability::Fsync).map_err(unopened)?;
    if let Some(needed) = missing_room(directory, &old)? {
        return Ok(Remade::NoRoom(needed));
    }
    let handles = old.handles()?;
    let Some(damage) = damage_in(handles.keyspace.iter())? else {
        return Ok(Remade::Whole);
    };
    warn!(
        damage,
        kept = %directory.join(DAMAGED_STORE).display(),
        "the store is damaged: it is made anew with all that can be read, and kept as it was"
    );
    make(directory, |new| copy(&handles, new))?;
    drop(handles);
    old.close();
    let whole = fs::rename(directory.join(NEW_STORE), directory.join(REMADE_STORE));
    whole
        .and_then(|()| sync_directory(directory.path()))
        .map_err(shut)?;
    finish(directory).map_err(shut)?;
    Ok(Remade::Anew)
}

/// Puts a store that was made anew in the place of the damaged one, if there is one; that one takes the place of one that
/// was damaged earlier.
pub(super) fn finish(directory: &Directory) -> io::Result<()> {
    let [store, remade, damaged] =
        [STORE, REMADE_STORE, DAMAGED_STORE].map(|name| directory.join(name));
    if !remade.try_exists()? {
        return Ok(());
    }
    if store.try_exists()? {
        if damaged.try_exists()? {
            fs::remove_dir_all(&damaged)?;
        }
        fs::rename(&store, &damaged)?;
    }
    fs::rename(&remade, &store)?;
    sync_directory(directory.path())?;
    info!("the store was made anew");
    Ok(())
}

/// What is damaged of these; a disk that cannot be read is an error.
fn damage_in(keys: impl Iterator<Item = Guard>) -> Result<Option<String>, LogError> {
    for key in keys {
        if let Err(error) = key.into_inner() {
            return damage(error).map(Some);
        }
    }
    Ok(None)
}

/// Copies all that can be read.
fn copy(old: &Handles, new: &Handles) -> Result<(), LogError> {
    let mut batch = Batch::new(new);
    for entry in old.keyspace.range(entries()) {
        let (key, value) = entry.into_inner().map_err(unopened)?;
        let number =
            number_of_entry(&key).ok_or_else(|| not_readable("a key of no known form".into()))?;
        let named = Named::decode(number, &value);
        // Of these only the entry matters.
        if let Some(Stage::Deleted | Stage::Copied) = named.as_ref().map(|named| named.stage) {
            batch.insert(key, value)?;
            continue;
        }
        match (damage_in(all_of(old, number))?, named) {
            (None, _) => {
                batch.insert(key, value)?;
                for pair in all_of(old, number) {
                    let (key, value) = pair.into_inner().map_err(unopened)?;
                    batch.insert(key, value)?;
                }
            }
            (Some(what), Some(named)) => {
                error!(index = named.entry.name, damage = what, "an index is lost");
                let stage = Stage::Unreadable;
                let named = Named { stage, ..named };
                batch.insert(key, named.encode(number).into())?;
            }
            (Some(_), None) => batch.insert(key, value)?,
        }
    }
    batch.commit()
}

/// All that a store holds of an index, but its entry.
fn all_of(handles: &Handles, number: Number) -> impl Iterator<Item = Guard> {
    let head = head_key(number);
    let many =
        [point_key, record_key, operation_key].map(|key| key(number, 0)..=key(number, u64::MAX));
    let many = many
        .into_iter()
        .flat_map(|range| handles.keyspace.range(range));
    handles.keyspace.range(head..=head).chain(many)
}

/// What is copied, some of it at a time.
struct Batch<'a> {
    store: &'a Handles,
    batch: OwnedWriteBatch,
    bytes: usize,
}

impl<'a> Batch<'a> {
    fn new(store: &'a Handles) -> Self {
        Self {
            store,
            batch: store.database.batch(),
            bytes: 0,
        }
    }

    fn insert(&mut self, key: Slice, value: Slice) -> Result<(), LogError> {
        self.bytes += key.len() + value.len();
        self.batch.insert(&self.store.keyspace, key, value);
        if self.bytes < BATCH_BYTES {
            return Ok(());
        }
        std::mem::replace(self, Self::new(self.store)).commit()
    }

    fn commit(self) -> Result<(), LogError> {
        self.store.wait_for_room()?;
        self.batch.commit().map_err(storage)
    }
}
