//! From the files to the state: what is in the store, whether it is whole, and whether it goes as far as the marks.

use std::{collections::BTreeMap, ops::RangeInclusive, sync::Arc};

use tracing::{error, warn};

use super::{
    index::{Index, State},
    layout::{Head, Named, Number, entry_key, head_key, number_of_entry, record_key},
    marks::Mark,
    store::{Store, storage},
};
use crate::log::{LogError, Uid};

/// What a store holds.
pub(super) struct Found {
    /// The indices; those that are damaged are closed.
    pub(super) indexes: Vec<Arc<Index>>,
    /// Indices that were deleted, of which there may be something left.
    pub(super) deleted: Vec<Number>,
    /// The number of the next index.
    pub(super) next: Number,
}

/// Reads the store. With `renamed` every index gets a new uid, as its past may be another one.
pub(super) fn recover(
    store: &Store,
    marks: &BTreeMap<Number, Mark>,
    renamed: bool,
) -> Result<Found, LogError> {
    let mut found = Found {
        indexes: Vec::new(),
        deleted: Vec::new(),
        // A mark without an index stands for one that was lost: its number stays taken.
        next: marks.keys().next_back().map_or(0, |last| last + 1),
    };
    let mut lost = marks.clone();
    for entry in store.keyspace.range(entries()) {
        let (key, value) = entry.into_inner().map_err(storage)?;
        let known = number_of_entry(&key)
            .and_then(|number| Some((number, Named::decode(number, &value)?)))
            .ok_or_else(|| storage("the entry of an index is damaged"));
        let (number, mut named) = known?;
        found.next = found.next.max(number + 1);
        let mark = lost.remove(&number);
        if named.deleted {
            found.deleted.push(number);
            continue;
        }
        let uid = named.entry.uid;
        if renamed {
            named.entry.uid = Uid::unique();
            store
                .keyspace
                .insert(entry_key(number), named.encode(number))
                .map_err(storage)?;
            warn!(index = named.entry.name, old = %uid, new = %named.entry.uid, "mutations may have been lost: new uid");
        }
        let index = Index::new(number, named.entry, State::empty());
        match state(store, &index, mark.filter(|mark| mark.uid == uid)) {
            Ok(state) => index.restore(state),
            Err(why) => {
                error!(index = index.entry.name, error = %why, "an index is damaged: every call for it will say so");
                index.close(why);
            }
        }
        found.indexes.push(index);
    }
    for mark in lost.values() {
        error!(uid = %mark.uid, revision = mark.revision, "an index is lost: it was stored up to this revision, and its files are gone or cut short");
    }
    Ok(found)
}

fn entries() -> RangeInclusive<[u8; 5]> {
    entry_key(0)..=entry_key(Number::MAX)
}

/// The state of an index, if all that a writer needs to know of it is whole.
fn state(store: &Store, index: &Index, mark: Option<Mark>) -> Result<State, LogError> {
    let (number, uid) = (index.number, index.entry.uid);
    let damaged = |revision, what| LogError::Damaged {
        uid,
        revision,
        what,
    };
    let mut state = State::empty();
    let stored = store.keyspace.get(head_key(number)).map_err(storage)?;
    if let Some(stored) = stored {
        let revision = mark.map_or(0, |mark| mark.revision);
        state.head = Head::decode(number, &stored)
            .ok_or_else(|| damaged(revision, "what is known of the newest revision is damaged"))?;
    }
    let head = state.head;
    if let Some(mark) = mark.filter(|mark| mark.revision > head.revision) {
        return Err(LogError::Lost {
            uid,
            first: head.revision + 1,
            last: mark.revision,
        });
    }
    state.removed = head.trimmed;
    let mut previous = None;
    for revision in head.trimmed + 1..=head.revision {
        let value = store.keyspace.get(record_key(number, revision));
        let record = index.record(revision, value.map_err(storage)?.as_deref())?;
        if previous.is_some_and(|previous| previous != *record.previous()) {
            return Err(damaged(revision, "it does not follow the record before it"));
        }
        let marked = mark.filter(|mark| mark.revision == revision);
        if marked.is_some_and(|mark| mark.digest != *record.digest()) {
            return Err(damaged(revision, "it is not the one that was synced"));
        }
        previous = Some(*record.digest());
        state.held(&record);
    }
    if previous.is_some_and(|previous| previous != head.digest) {
        return Err(damaged(head.revision, "it is not the newest"));
    }
    Ok(state)
}
