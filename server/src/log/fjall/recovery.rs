//! From the files to the state: the content of the store, checked for damage and against the sync marks.

use std::{
    collections::{BTreeMap, BTreeSet},
    sync::Arc,
};

use fjall::{Guard, KvPair, Slice};
use tracing::{error, warn};

use super::{
    DAMAGED_STORE,
    index::{Index, State},
    layout::{
        Head, Number, Stage, StagedEntry, Sum, entry_key, head_key, number_of_entry, record_key,
    },
    session,
    store::{Handles, damage, damaged_index, unopened, unreadable},
    sync_marks::{Mark, MarkTable},
};
use crate::log::{Entry, LogError, LostIndex, Origin, Uid};

/// The content of a store.
pub(super) struct StoreContent {
    /// The indices; damaged ones are closed.
    pub(super) indexes: Vec<Arc<Index>>,
    /// True if a part of the indices was unreadable.
    pub(super) unreadable: bool,
    /// Lost indices, of which only the mark is left.
    pub(super) lost: BTreeMap<Number, LostIndex>,
    /// Deleted indices that may have keys left.
    pub(super) deleted: Vec<Number>,
    /// The number of the next index.
    pub(super) next: Number,
    /// The numbers that have an entry or a mark. The others are of deleted indices.
    pub(super) used: BTreeSet<Number>,
}

/// Reads the store. With `may_have_lost` every whole index gets a new uid, because its history may have changed.
pub(super) fn recover(
    handles: &Handles,
    marks: &MarkTable,
    may_have_lost: bool,
) -> Result<StoreContent, LogError> {
    let mut found = StoreContent {
        indexes: Vec::new(),
        unreadable: false,
        lost: BTreeMap::new(),
        deleted: Vec::new(),
        // The number of a lost index stays in use.
        next: marks.next(),
        used: BTreeSet::new(),
    };
    let mut left: BTreeMap<Number, &Mark> = marks.live().collect();
    for (number, entry) in stored_entries(handles, marks)? {
        found.next = found.next.max(number + 1);
        found.used.insert(number);
        let value = match entry {
            Ok(value) => value,
            Err(damage) => {
                found.unreadable = true;
                if let Some(mark) = left.remove(&number) {
                    found.add_lost(number, mark, damaged_index(mark.uid, &damage));
                }
                continue;
            }
        };
        let Some(staged) = StagedEntry::decode(number, &value) else {
            if !marks.is_marked(number) {
                error!(
                    number,
                    "the entry of an index is damaged, and no mark names it"
                );
            }
            continue;
        };
        let (mark, was_deleted) = (left.get(&number).copied(), marks.is_deleted(number));
        match staged.stage {
            // A lost index; it is reported below.
            Stage::Copied if mark.is_some() => continue,
            Stage::Whole | Stage::Unreadable if was_deleted => {
                warn!(
                    index = staged.entry.name,
                    "the journal files were cut short: a deleted index reappeared and is deleted again"
                );
                found.deleted.push(number);
            }
            Stage::Deleted | Stage::Copied => found.deleted.push(number),
            Stage::Whole => {
                let index = open(handles, number, staged, mark, may_have_lost)?;
                found.unreadable |= matches!(index.durable(), Err(LogError::Unreadable { .. }));
                found.indexes.push(index);
            }
            Stage::Unreadable => found
                .indexes
                .push(unreadable_index(number, staged.entry, mark)),
        }
        left.remove(&number);
    }
    for (number, mark) in left {
        let why = LogError::Lost {
            uid: mark.uid,
            first: 1,
            last: mark.revision,
        };
        found.add_lost(number, mark, why);
    }
    Ok(found)
}

impl StoreContent {
    /// The names and errors of the indices that are damaged although their files can be read.
    pub(super) fn beyond_repair(&self) -> BTreeMap<Number, (String, String)> {
        let closed = self.indexes.iter().filter_map(|index| {
            let why = index.durable().err()?;
            Some((index.number, (&index.entry.name, why)))
        });
        let lost = self.lost.iter();
        let lost = lost.map(|(number, lost)| (*number, (&lost.name, lost.why.clone())));
        let readable = closed.chain(lost);
        let readable = readable.filter(|(_, (_, why))| !matches!(why, LogError::Unreadable { .. }));
        readable
            .map(|(number, (name, why))| (number, (name.clone(), why.to_string())))
            .collect()
    }

    /// Adds a lost index. Only its mark is left.
    fn add_lost(&mut self, number: Number, mark: &Mark, why: LogError) {
        error!(index = &*mark.name, error = %why, "an index is lost: every call for it fails");
        let (name, uid) = (mark.name.to_string(), mark.uid);
        self.used.insert(number);
        self.lost.insert(number, LostIndex { name, uid, why });
    }
}

/// The entry of a number, or its damage.
pub(super) type StoredEntry = (Number, Result<Slice, String>);

/// The entry of each number that has one. A damaged entry without a mark is an error.
pub(super) fn stored_entries(
    handles: &Handles,
    marks: &MarkTable,
) -> Result<Vec<StoredEntry>, LogError> {
    let all = entry_key(0)..=entry_key(Number::MAX);
    let newest = match handles.keyspace.range(all).next_back().map(Guard::key) {
        Some(Err(error)) if marks.is_empty() => return Err(unopened(error)),
        Some(Ok(key)) => number_of_entry(&key),
        Some(Err(_)) | None => None,
    };
    let end = newest.map_or(0, |newest| newest + 1).max(marks.next());
    let mut found = Vec::new();
    for number in 0..end {
        match read_one(handles, &entry_key(number)) {
            None => {}
            Some(Ok((_, entry))) => found.push((number, Ok(entry))),
            Some(Err(error)) if !marks.is_marked(number) => return Err(unopened(error)),
            Some(Err(error)) => found.push((number, Err(damage(error)?))),
        }
    }
    Ok(found)
}

/// The key and value of a key. A range would also read a neighbouring block, and only a get reads the filters and
/// indices that lead to a single key.
pub(super) fn read_one(handles: &Handles, key: &[u8]) -> Option<fjall::Result<KvPair>> {
    match handles.keyspace.get(key) {
        Ok(value) => value.map(|value| Ok((key.into(), value))),
        Err(_) => handles
            .keyspace
            .range(key..=key)
            .next()
            .map(Guard::into_inner),
    }
}

/// Opens one index. A damaged one is closed and keeps its uid: its mark has that uid too, and tells the next start what is
/// lost.
fn open(
    handles: &Handles,
    number: Number,
    mut staged: StagedEntry,
    mark: Option<&Mark>,
    may_have_lost: bool,
) -> Result<Arc<Index>, LogError> {
    let uid = staged.entry.uid;
    let new_index = |entry: &Entry| {
        let state = State::new(Origin::START, Sum::default());
        Index::new(number, entry.clone(), state)
    };
    let mut index = new_index(&staged.entry);
    match state(handles, &index, mark.filter(|mark| mark.uid == uid)) {
        Ok(state) => {
            if may_have_lost {
                staged.entry.uid = Uid::unique();
                let entry = staged.encode(number);
                let stored = handles.keyspace.insert(entry_key(number), entry);
                stored.map_err(unopened)?;
                warn!(index = staged.entry.name, old = %uid, new = %staged.entry.uid, "mutations may have been lost: new uid");
                index = new_index(&staged.entry);
            }
            index.set_recovered(state);
        }
        // This is an error of the disk, not of this index.
        Err(LogError::Storage { what }) => return Err(LogError::Shut { what }),
        Err(error @ LogError::StorageStopped) => {
            let what = error.to_string();
            return Err(LogError::Shut { what });
        }
        Err(why) => {
            error!(index = index.entry.name, error = %why, "an index is damaged: every call for it fails");
            index.close(why);
        }
    }
    Ok(index)
}

/// An index of which a rebuilt store holds only the entry.
fn unreadable_index(number: Number, entry: Entry, mark: Option<&Mark>) -> Arc<Index> {
    let revisions = match mark.map_or(0, |mark| mark.revision) {
        0 => String::new(),
        last => format!(" of the revisions 1 to {last}"),
    };
    let why = LogError::Unreadable {
        uid: entry.uid,
        what: format!(
            "a block{revisions} could not be read when the store was repaired, and the index was left out; the damaged \
             store is kept in the data directory as one of {DAMAGED_STORE}N"
        ),
    };
    error!(index = entry.name, error = %why, "an index is damaged: every call for it fails");
    let index = Index::new(number, entry, State::new(Origin::START, Sum::default()));
    index.close(why);
    index
}

/// The state of an index; an error if anything that a writer needs is damaged. The points are checked when they are
/// first read.
fn state(handles: &Handles, index: &Index, mark: Option<&Mark>) -> Result<State, LogError> {
    let (number, uid) = (index.number, index.entry.uid);
    let damaged = |revision, what| LogError::damaged_record(uid, revision, what);
    let get = |key: &[u8]| {
        let value = handles.keyspace.get(key);
        value.map_err(|error| unreadable(uid, error))
    };
    let mut state = State::unchecked();
    let marked = mark.as_ref().map_or(0, |mark| mark.revision);
    if let Some(stored) = get(&head_key(number))? {
        state.head = Head::decode(number, &stored)
            .ok_or_else(|| damaged(marked, "the head of the index is damaged"))?;
    }
    let head = state.head;
    if marked > head.revision {
        return Err(LogError::Lost {
            uid,
            first: head.revision + 1,
            last: marked,
        });
    }
    state.removed = head.trimmed;
    let mut previous = None;
    for revision in head.trimmed + 1..=head.revision {
        let value = get(&record_key(number, revision))?;
        let record = index.record(revision, value.as_deref())?;
        if previous.is_some_and(|previous| previous != *record.previous()) {
            return Err(damaged(revision, "it does not follow the record before it"));
        }
        let synced = mark.as_ref().filter(|mark| mark.revision == revision);
        if synced.is_some_and(|mark| mark.digest != *record.digest()) {
            return Err(damaged(revision, "it is not the one that was synced"));
        }
        previous = Some(*record.digest());
        state.count_record(&record);
    }
    if previous.is_some_and(|previous| previous != head.digest) {
        return Err(damaged(head.revision, "it is not the newest"));
    }
    for (revision, operation) in index.stored_operations(handles)? {
        state.count_operation(revision, &operation);
    }
    state.sessions = session::read(handles, number, uid)?;
    Ok(state)
}

#[cfg(test)]
mod tests;
