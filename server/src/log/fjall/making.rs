//! How a store comes to be: with nothing in it, or from one that is damaged, with all that can be read of it.
//!
//! fjall rewrites its files by and by, with whatever is written. Where it comes upon a block then that is not what it
//! wrote, it stops writing for good, and so it would for all indices and at every start anew. So a store of which a
//! block cannot be read is made anew: indices that can be read whole are copied key by key, of others the entry is left,
//! which says so. The damaged store stays beside it, under a name of its own.
//!
//! A store in the making takes its name once it is whole and synced; a start that finds it so goes on from there
//! ([`finish`]).

use std::{collections::BTreeMap, fs, io, ops::RangeInclusive, sync::Arc};

use fjall::{Guard, OwnedWriteBatch, Slice};
use tracing::{error, info, warn};

use super::{
    DAMAGED_STORE, Durability, MARKS, NEW_STORE, REMADE_STORE, STORE,
    directory::{Directory, sync_directories, sync_directory},
    journal::Journal,
    layout::{
        Head, Named, Number, Stage, entry_key, head_key, number_of_entry, operation_key,
        point_keys, record_key,
    },
    manifest, manifest_copy,
    marks::{Mark, Marks},
    recovery::entries,
    store::{Handles, Store, damage, shut, storage, unopened},
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
    remove_unfinished(directory)?;
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

/// How many bytes must be free for a store to be made anew, if it is damaged and fewer are; 0 otherwise. An error if the
/// disk does not let it be read.
pub(super) fn missing_room(directory: &Directory, store: &Store) -> Result<u64, LogError> {
    let handles = store.handles()?;
    let damage = damage_in(handles.keyspace.iter())?;
    Ok(damage.map_or(0, |_| lacking(directory, &handles)))
}

fn lacking(directory: &Directory, handles: &Handles) -> u64 {
    let needed = handles.room_for_copy();
    match directory.has_room(needed) {
        Ok(()) => 0,
        Err(error) => {
            error!(%error, "no room to make the store anew");
            needed
        }
    }
}

/// Reads a store, which is closed, from end to end, and makes it anew if it is damaged; also if that does not show, where
/// something of it is known to be `unreadable`: what leads to single keys is not read on the way from end to end.
pub(super) fn remake(directory: &Directory, unreadable: bool) -> Result<Remade, LogError> {
    let path = directory.join(STORE);
    manifest_copy::mend(directory)?;
    manifest::check(&path)?;
    remove_unfinished(directory)?;
    let old = Store::open(&path, Durability::Fsync).map_err(unopened)?;
    let handles = old.handles()?;
    let damage = match damage_in(handles.keyspace.iter())? {
        None if !unreadable => return Ok(Remade::Whole),
        damage => damage.unwrap_or_else(|| "what leads to its keys cannot be read".into()),
    };
    let needed = lacking(directory, &handles);
    if needed > 0 {
        return Ok(Remade::NoRoom(needed));
    }
    warn!(
        damage,
        "the store is damaged: it is made anew with all that can be read"
    );
    let (_, marks) = Marks::open(&directory.join(MARKS)).map_err(shut)?;
    make(directory, |new| copy(&handles, new, &marks))?;
    drop(handles);
    old.close();
    let whole = fs::rename(directory.join(NEW_STORE), directory.join(REMADE_STORE));
    whole
        .and_then(|()| sync_directory(directory.path()))
        .map_err(shut)?;
    Ok(Remade::Anew)
}

/// Removes what is left of a store that was not made to its end.
fn remove_unfinished(directory: &Directory) -> Result<(), LogError> {
    match fs::remove_dir_all(directory.join(NEW_STORE)) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => Err(shut(error)),
        _ => Ok(()),
    }
}

/// Puts a store that was made anew in the place of the damaged one, if there is one. Until that is done the damaged one is
/// not to be written to.
pub(super) fn finish(directory: &Directory) -> io::Result<()> {
    let [store, remade] = [STORE, REMADE_STORE].map(|name| directory.join(name));
    if !remade.try_exists()? {
        return Ok(());
    }
    if store.try_exists()? {
        let kept = (1..).map(|number| directory.join(&format!("{DAMAGED_STORE}{number}")));
        for kept in kept {
            if !kept.try_exists()? {
                fs::rename(&store, &kept)?;
                warn!(kept = %kept.display(), "the store as it was is kept");
                break;
            }
        }
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

/// Copies all that can be read of the indices.
fn copy(old: &Handles, new: &Handles, marks: &BTreeMap<Number, Mark>) -> Result<(), LogError> {
    let mut batch = Batch::new(new);
    for number in numbers(old, marks)? {
        let key = entry_key(number);
        let entry = match old.keyspace.range(key..=key).next().map(Guard::into_inner) {
            None => continue,
            Some(Ok((_, value))) => value,
            // Its mark tells of it; without one nothing would.
            Some(Err(error)) if !marks.contains_key(&number) => return Err(unopened(error)),
            Some(Err(error)) => {
                let damage = damage(error)?;
                error!(number, damage, "the entry of an index is lost");
                continue;
            }
        };
        let named = Named::decode(number, &entry);
        // Of these only the entry matters.
        if let Some(Stage::Deleted | Stage::Copied) = named.as_ref().map(|named| named.stage) {
            batch.insert(key.into(), entry)?;
            continue;
        }
        match (damage_in(all_of(old, number))?, named) {
            (None, _) => {
                batch.insert(key.into(), entry)?;
                for pair in all_of(old, number) {
                    let (key, value) = pair.into_inner().map_err(unopened)?;
                    batch.insert(key, value)?;
                }
            }
            (Some(damage), Some(named)) => {
                error!(index = named.entry.name, damage, "an index is lost");
                let stage = Stage::Unreadable;
                let named = Named { stage, ..named };
                batch.insert(key.into(), named.encode(number).into())?;
            }
            (Some(_), None) => batch.insert(key.into(), entry)?,
        }
    }
    batch.commit()
}

/// The numbers that indices may have. Where the last entry cannot be read, and no mark knows how many there are, it is an
/// error.
fn numbers(
    store: &Handles,
    marks: &BTreeMap<Number, Mark>,
) -> Result<RangeInclusive<Number>, LogError> {
    let newest = store.keyspace.range(entries()).next_back();
    let newest = match newest.map(Guard::key) {
        Some(Err(error)) if marks.is_empty() => return Err(unopened(error)),
        Some(Ok(key)) => number_of_entry(&key),
        Some(Err(_)) | None => None,
    };
    let marked = marks.keys().next_back().copied();
    Ok(0..=newest.max(marked).unwrap_or_default())
}

/// All that recovery reads of an index, but its entry: of records that were trimmed nothing is left to be lost.
fn all_of(handles: &Handles, number: Number) -> impl Iterator<Item = Guard> {
    let range = |range| handles.keyspace.range(range);
    let head = head_key(number);
    let found = handles.keyspace.range(head..=head).next();
    let found = found.and_then(|head| Head::decode(number, &head.value().ok()?));
    let trimmed = found.map_or(0, |head| head.trimmed);
    let records = record_key(number, trimmed.saturating_add(1))..=record_key(number, u64::MAX);
    let operations = operation_key(number, 0)..=operation_key(number, u64::MAX);
    let many = [point_keys(number), records, operations];
    handles
        .keyspace
        .range(head..=head)
        .chain(many.into_iter().flat_map(range))
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
