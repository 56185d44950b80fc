//! Makes a store: an empty one, or one rebuilt from a damaged store with every readable index.
//!
//! fjall rewrites its files step by step in the background. If it meets a damaged block, it permanently stops all
//! writing, for all indices, and does so again after every start. [`repair`] copies the fully readable indices into a
//! new store, key by key. It keeps only the entries of the other indices, which say that the rest is lost. The damaged
//! store is kept under another name.
//!
//! A new store is renamed to its final name once it is whole and synced. If the renaming is interrupted, [`finish`]
//! completes it at the next start.

use std::{
    fs, io,
    path::{Path, PathBuf},
    sync::Arc,
};

use fjall::{Guard, KvPair, Slice};
use thiserror::Error;
use tracing::{debug, info, warn};

use super::{
    DAMAGED_STORE, Durability, MARKS, NEW_STORE, OpenError, REBUILT_STORE, STORE,
    directory::{Directory, require_store, sync_directories, sync_directory},
    journal::{self, StoreJournal},
    layout::{
        Head, Number, Stage, StagedEntry, block_key, entry_key, head_key, operation_key, point_key,
        record_key, session_key,
    },
    manifest, manifest_copy,
    recovery::{self, read_one, stored_entries},
    store::{Handles, Store, damage, shut, storage, unopened},
    sync_marks::{MarkTable, Marks},
    torn_batch,
};
use crate::log::LogError;

/// The outcome of [`repair`].
#[derive(Debug)]
pub struct RepairReport {
    /// The first damage that was found. None if all of the store can be read; nothing else was done then.
    pub damage: Option<String>,
    /// The number of indices that can be read whole and have lost no record.
    pub whole: usize,
    /// The names of the indices that the new store does not hold, each with its damage.
    pub lost: Vec<(String, String)>,
    /// The names of the other indices whose records are lost or wrong in readable files, each with its error. No repair
    /// brings these back.
    pub beyond_repair: Vec<(String, String)>,
    /// Bytes that must be free to rebuild the store.
    pub needed_bytes: u64,
    /// Bytes that are free.
    pub free_bytes: u64,
    /// The path of the kept damaged store; None if nothing was rebuilt.
    pub kept: Option<PathBuf>,
}

impl RepairReport {
    /// Fails if the disk has no room for the new store.
    fn check_room(&self) -> Result<(), RepairError> {
        let (needed, free) = (self.needed_bytes, self.free_bytes);
        match free < needed {
            true => Err(RepairError::NoRoom { needed, free }),
            false => Ok(()),
        }
    }
}

/// The error of a repair.
#[derive(Debug, Error)]
pub enum RepairError {
    /// The data directory cannot be used.
    #[error(transparent)]
    Directory(#[from] OpenError),
    /// The store cannot be read or written at all.
    #[error("the store cannot be repaired ({}); nothing of it was removed", cause(.0))]
    Log(#[from] LogError),
    /// The disk is too full.
    #[error(
        "{needed} bytes must be free to rebuild the store, and {free} are: free some, nothing was rebuilt"
    )]
    NoRoom {
        /// Bytes that must be free.
        needed: u64,
        /// Bytes that are free.
        free: u64,
    },
}

/// The cause of an error, without its consequences for a server: none runs during a repair.
fn cause(error: &LogError) -> String {
    match error {
        LogError::Unopened { what, .. } | LogError::Shut { what } | LogError::Storage { what } => {
            what.clone()
        }
        LogError::StorageStopped => "an earlier failure to write".into(),
        error => error.to_string(),
    }
}

/// Makes an empty store, unless a store exists or existed: if the file of marks exists, a missing store is a lost one.
/// An interrupted start leaves no store or a whole one.
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

/// Makes a store under the name [`NEW_STORE`]. It is durable, with everything that `fill` writes to it.
fn make(
    directory: &Directory,
    fill: impl FnOnce(&Handles) -> Result<(), LogError>,
) -> Result<(), LogError> {
    remove_unfinished(directory).map_err(shut)?;
    let new = directory.join(NEW_STORE);
    let made = Arc::new(Store::open(&new, Durability::Fsync).map_err(unopened)?);
    fill(&*made.handles()?)?;
    StoreJournal::new(Arc::clone(&made), new.clone()).sync()?;
    made.close()?;
    // fjall does not sync the names in its directories.
    sync_directories(&new).map_err(shut)
}

/// Removes a store that was begun and not finished.
fn remove_unfinished(directory: &Directory) -> io::Result<()> {
    match fs::remove_dir_all(directory.join(NEW_STORE)) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => Err(error),
        _ => Ok(()),
    }
}

/// Reads the whole store in a data directory, and rebuilds it if a part is unreadable, unless it is a `dry_run`. Opens the
/// store as a start does: an interrupted repair is finished, shared files are mended, and the journal is made durable.
/// A `dry_run` does not cut a torn batch off the journal. No server may use the directory.
pub fn repair(directory: &Path, dry_run: bool) -> Result<RepairReport, RepairError> {
    require_store(directory)?;
    let directory = Directory::take(directory)?;
    finish(&directory).map_err(shut)?;
    manifest_copy::mend(&directory)?;
    let was_clean = journal::ensure_durable(&directory).map_err(shut)?;
    let path = directory.join(STORE);
    manifest::check(&path)?;
    let (_, marks) = Marks::open(&directory.join(MARKS)).map_err(shut)?;
    let opened = match dry_run {
        true => Store::open(&path, Durability::Fsync),
        false => torn_batch::open(&directory, Durability::Fsync),
    };
    let old = opened.map_err(unopened)?;
    let handles = old.handles()?;
    let contents = survey(&handles, &marks)?;
    let damage = find_damage(&handles)?;
    let found = recovery::recover(&handles, &marks, false)?;
    let mut beyond_repair = found.beyond_repair();
    for content in contents.iter().filter(|content| content.lost.is_some()) {
        beyond_repair.remove(&content.number);
    }
    let is_whole = |it: &&Content| it.whole && !beyond_repair.contains_key(&it.number);
    let mut report = RepairReport {
        damage,
        whole: contents.iter().filter(is_whole).count(),
        lost: contents
            .iter()
            .filter_map(|content| content.lost.clone())
            .collect(),
        beyond_repair: beyond_repair.into_values().collect(),
        needed_bytes: handles.room_for_copy(),
        free_bytes: directory.room().map_err(shut)?,
        kept: None,
    };
    // A read of all keys in order does not read the filters and indices that lead to single keys.
    if report.damage.is_none() && found.unreadable {
        report.damage = Some("its filters or indices cannot be read".into());
    }
    if report.damage.is_none() || dry_run {
        drop(handles);
        let synced = old.close();
        // Without the marker the next start rewrites the journal.
        if was_clean
            && synced.is_ok()
            && let Err(error) = journal::mark_synced(&directory)
        {
            debug!(%error, "cannot mark the journal as synced");
        }
        return Ok(report);
    }
    report.check_room()?;
    make(&directory, |new| copy(&handles, new, contents)).inspect_err(|_| {
        // If this fails too, the next start removes it.
        let _ = remove_unfinished(&directory);
    })?;
    drop(handles);
    // The damaged store is kept whether or not its journal can be synced.
    let _ = old.close();
    let rebuilt = fs::rename(directory.join(NEW_STORE), directory.join(REBUILT_STORE));
    rebuilt
        .and_then(|()| sync_directory(directory.path()))
        .map_err(shut)?;
    report.kept = finish(&directory).map_err(shut)?;
    Ok(report)
}

/// Replaces the damaged store by the rebuilt one, if there is one, and returns the new path of the damaged store. Removes a
/// store that was not finished. The damaged store must not be written to before this call.
pub(super) fn finish(directory: &Directory) -> io::Result<Option<PathBuf>> {
    if let Err(error) = remove_unfinished(directory) {
        warn!(%error, "cannot remove {NEW_STORE}, which was not finished");
    }
    let [store, rebuilt] = [STORE, REBUILT_STORE].map(|name| directory.join(name));
    if !rebuilt.try_exists()? {
        return Ok(None);
    }
    let mut moved = None;
    if store.try_exists()? {
        for number in 1.. {
            let kept = directory.join(&format!("{DAMAGED_STORE}{number}"));
            if !kept.try_exists()? {
                fs::rename(&store, &kept)?;
                warn!(kept = %kept.display(), "the damaged store is kept");
                moved = Some(kept);
                break;
            }
        }
    }
    fs::rename(&rebuilt, &store)?;
    sync_directory(directory.path())?;
    info!("the rebuilt store is in place");
    Ok(moved)
}

/// The first damage in an open store; None if all of it is readable. An unreadable disk is an error.
pub(super) fn find_damage(handles: &Handles) -> Result<Option<String>, LogError> {
    damage_in(handles.keyspace.iter().map(Guard::into_inner))
}

fn damage_in(
    mut pairs: impl Iterator<Item = fjall::Result<KvPair>>,
) -> Result<Option<String>, LogError> {
    pairs.find_map(Result::err).map(damage).transpose()
}

/// The part of an index that a rebuilt store takes over.
struct Content {
    number: Number,
    /// The new entry; None if only the mark of the index is left.
    entry: Option<Slice>,
    /// True if everything else is readable and is copied.
    whole: bool,
    /// The name and the damage of an index that is lost.
    lost: Option<(String, String)>,
}

/// Surveys the readable part of each index.
fn survey(store: &Handles, marks: &MarkTable) -> Result<Vec<Content>, LogError> {
    let mut contents = Vec::new();
    for (number, entry) in stored_entries(store, marks)? {
        let mut content = Content {
            number,
            entry: None,
            whole: false,
            lost: None,
        };
        match entry {
            Err(damage) => {
                let live = marks.get(number).filter(|mark| !mark.deleted);
                content.lost = live.map(|mark| (mark.name.to_string(), damage));
            }
            Ok(entry) => {
                let staged = StagedEntry::decode(number, &entry);
                let is_live = staged
                    .as_ref()
                    .is_none_or(|staged| staged.stage == Stage::Whole);
                let damage = if is_live {
                    damage_in(all_of(store, number))?
                } else {
                    None
                };
                content.whole = is_live && damage.is_none();
                content.entry = Some(entry);
                if let (Some(staged), Some(damage)) = (staged, damage) {
                    content.lost = Some((staged.entry.name.clone(), damage));
                    let stage = Stage::Unreadable;
                    content.entry = Some(StagedEntry { stage, ..staged }.encode(number).into());
                }
            }
        }
        contents.push(content);
    }
    Ok(contents)
}

fn copy(old: &Handles, new: &Handles, contents: Vec<Content>) -> Result<(), LogError> {
    let put = |key: Slice, value: Slice| {
        let _room = new.wait_for_room()?;
        new.keyspace.insert(key, value).map_err(storage)
    };
    for content in contents {
        if let Some(entry) = content.entry {
            put(entry_key(content.number).into(), entry)?;
        }
        if content.whole {
            for pair in all_of(old, content.number) {
                let (key, value) = pair.map_err(unopened)?;
                put(key, value)?;
            }
        }
    }
    Ok(())
}

/// Everything that recovery reads of an index, without its entry. Trimmed records do not matter.
fn all_of(handles: &Handles, number: Number) -> impl Iterator<Item = fjall::Result<KvPair>> {
    let head = read_one(handles, &head_key(number));
    let decoded = match &head {
        Some(Ok((_, head))) => Head::decode(number, head),
        _ => None,
    };
    let records = decoded
        .into_iter()
        .flat_map(|head| head.trimmed + 1..=head.revision);
    let records =
        records.filter_map(move |revision| read_one(handles, &record_key(number, revision)));
    let ranges = [point_key, operation_key, session_key, block_key].into_iter();
    let ranges = ranges.map(move |key| key(number, 0)..=key(number, u64::MAX));
    let ranges = ranges.flat_map(|range| handles.keyspace.range(range).map(Guard::into_inner));
    head.into_iter().chain(ranges).chain(records)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_failed_repair_names_the_cause_and_no_server() {
        let what = "No space left on device";
        for error in [
            LogError::Unopened {
                revision: 0,
                what: what.into(),
            },
            LogError::Shut { what: what.into() },
            LogError::Storage { what: what.into() },
            LogError::StorageStopped,
        ] {
            let text = RepairError::from(error.clone()).to_string();
            assert!(!text.contains("server"), "{text}");
            assert!(text.ends_with("; nothing of it was removed"), "{text}");
            let has_cause = text.contains(what) || error == LogError::StorageStopped;
            assert!(has_cause, "{text}");
        }
    }

    #[test]
    fn a_repair_needs_as_many_free_bytes_as_it_names() {
        let report = |free_bytes| RepairReport {
            damage: Some("a block".into()),
            whole: 1,
            lost: Vec::new(),
            beyond_repair: Vec::new(),
            needed_bytes: 4096,
            free_bytes,
            kept: None,
        };
        report(4096).check_room().unwrap();
        let refused = report(4095).check_room().unwrap_err().to_string();
        assert!(refused.contains("4096 bytes must be free"), "{refused}");
        assert!(refused.contains("4095 are"), "{refused}");
    }
}
