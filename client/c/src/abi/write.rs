//! The functions that store, change and read the points of an index.

use client::{Error, Index, InsertOptions};

use super::{
    index::WayfoldIndex,
    pointers::{check_width, copy, index_of, null, put, rows, values},
    search::write_neighbors,
};
use crate::{
    code::Code,
    failure::{Failure, call},
    options::{WayfoldPoint, WayfoldSearch},
};

/// Stores `count` states and writes their ids, which ascend; `ids` may be null. An index in memory stores all or none.
/// The other forms may divide many rows, and a part may fail after others were stored. The reason is "PARTIAL" then,
/// the code is that of the part, `wayfold_error_rows_done` tells how many rows are stored, from the first on, and `ids`
/// gets the ids of these. Repeat only the rows after them: a repeated row is a second point. The next rows of a remote
/// insert may be stored too if the code is `DEADLINE_EXCEEDED`, `CANCELLED`, `UNKNOWN`, `INTERNAL`, `DATA_LOSS` or
/// `UNAVAILABLE`: look before you repeat them. If a shared index was closed, or the server refused its writes, those
/// of the stored rows that the server had not taken are among the unsent writes instead.
///
/// Thread-safe.
///
/// # Safety
/// `states` has `count × width` numbers; `ids` has room for `count`.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn wayfold_index_insert(
    index: *const WayfoldIndex,
    states: *const f64,
    count: usize,
    width: usize,
    ids: *mut u64,
) -> Code {
    call(|| {
        // SAFETY: the caller's promise.
        let index = unsafe { index_of(index) }?;
        // SAFETY: the caller's promise.
        let rows = unsafe { rows(index, states, count, width, "states") }?;
        if count == 1 {
            let id = index.insert(rows)?;
            // SAFETY: the caller's promise.
            unsafe { copy(&[id], ids) };
        } else {
            let stored = index.insert_many(rows.chunks_exact(width));
            let done = match &stored {
                Ok(stored) | Err(Error::Partial { ids: stored, .. }) => &stored[..],
                Err(_) => &[],
            };
            // SAFETY: the caller's promise. No more rows are stored than were given.
            unsafe { copy(done, ids) };
            stored?;
        }
        Ok(())
    })
}

/// Stores a state with a tag, a payload or an id, and writes its id; `id` may be null. `search` may be null; otherwise
/// the neighbours that the state had at its insertion are written as by `wayfold_index_search`. `read_revision` gets
/// the revision of the insertion, for `since` of a later search; it may be null.
///
/// A remote index does not end this search by its `timeout_ms`, but by that of the call. The reason "PARTIAL" means that
/// it stored the point, under an id that the error does not tell: the answer was larger than the client reads.
///
/// Thread-safe.
///
/// # Safety
/// `state` has `width` numbers; `ids` and `distances` have room for `capacity` if they are not null; `found` can be
/// written if `search` is not null; `read_revision` can be written or is null.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn wayfold_index_insert_with(
    index: *const WayfoldIndex,
    state: *const f64,
    width: usize,
    point: *const WayfoldPoint,
    id: *mut u64,
    search: *const WayfoldSearch,
    capacity: usize,
    ids: *mut u64,
    distances: *mut f64,
    found: *mut usize,
    read_revision: *mut u64,
) -> Code {
    call(|| {
        // SAFETY: the caller's promise.
        let index = unsafe { index_of(index) }?;
        // SAFETY: the caller's promise.
        let row = unsafe { rows(index, state, 1, width, "state") }?;
        // SAFETY: the caller's promise.
        let point = unsafe { point.as_ref() }.ok_or_else(|| null("point"))?;
        // SAFETY: the caller's promise.
        let payload = unsafe { values(point.payload, point.payload_bytes, "payload") }?;
        let mut options = InsertOptions::new().tag(point.tag).payload(payload);
        if point.id != u64::MAX {
            options = options.id(point.id);
        }
        // SAFETY: the caller's promise.
        let search = unsafe { search.as_ref() }.map(WayfoldSearch::search);
        if let Some(search) = search {
            // Before the point is stored: a retry would store it again.
            if found.is_null() {
                return Err(null("found"));
            }
            options = options.neighbors(search);
        }
        let inserted = index.insert_with(row, options)?;
        // SAFETY: the caller's promise.
        unsafe {
            copy(&[inserted.id], id);
            copy(&[inserted.neighbors.read_revision.0], read_revision);
            if search.is_some() {
                let neighbors = &inserted.neighbors.neighbors;
                write_neighbors(neighbors, capacity, ids, distances);
                put(neighbors.len(), found, "found")?;
            }
        }
        Ok(())
    })
}

/// Removes the point with this id; writes false if there is none. `removed` may be null.
///
/// Thread-safe.
///
/// # Safety
/// `index` is a handle; `removed` can be written or is null.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn wayfold_index_remove(
    index: *const WayfoldIndex,
    id: u64,
    removed: *mut bool,
) -> Code {
    // SAFETY: the caller's promise.
    unsafe { change(index, removed, |index| Ok(index.remove(id)?)) }
}

/// Moves the point with this id to another state; it keeps its tag and loses its payload. Writes false if there is none.
/// `replaced` may be null.
///
/// A remote index makes two calls: a tag that another process sets between them is lost, and a removal is undone.
/// `replaced` is true then too.
///
/// Thread-safe.
///
/// # Safety
/// `state` has `width` numbers; `replaced` can be written or is null.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn wayfold_index_replace(
    index: *const WayfoldIndex,
    id: u64,
    state: *const f64,
    width: usize,
    replaced: *mut bool,
) -> Code {
    let replace = |index: &Index| {
        // SAFETY: the caller's promise.
        let row = unsafe { rows(index, state, 1, width, "state") }?;
        Ok(index.replace(id, row)?)
    };
    // SAFETY: the caller's promise.
    unsafe { change(index, replaced, replace) }
}

/// Sets the tag of the point with this id; writes false if there is none. `set` may be null.
///
/// Thread-safe.
///
/// # Safety
/// `index` is a handle; `set` can be written or is null.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn wayfold_index_set_tag(
    index: *const WayfoldIndex,
    id: u64,
    tag: u64,
    set: *mut bool,
) -> Code {
    // SAFETY: the caller's promise.
    unsafe { change(index, set, |index| Ok(index.set_tag(id, tag)?)) }
}

/// Sets the payload of the point with this id; writes false if there is none. `set` may be null.
///
/// Thread-safe.
///
/// # Safety
/// `payload` has `payload_bytes` bytes; `set` can be written or is null.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn wayfold_index_set_payload(
    index: *const WayfoldIndex,
    id: u64,
    payload: *const u8,
    payload_bytes: usize,
    set: *mut bool,
) -> Code {
    let set_payload = |index: &Index| {
        // SAFETY: the caller's promise.
        let payload = unsafe { values(payload, payload_bytes, "payload") }?;
        Ok(index.set_payload(id, payload)?)
    };
    // SAFETY: the caller's promise.
    unsafe { change(index, set, set_payload) }
}

/// Writes the tag and the canonical state of the point with this id, or false to `found` if there is none. `tag` and
/// `state` may be null.
///
/// Thread-safe.
///
/// # Safety
/// `state` has room for `width` numbers; `tag` and `found` can be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn wayfold_index_get(
    index: *const WayfoldIndex,
    id: u64,
    tag: *mut u64,
    state: *mut f64,
    width: usize,
    found: *mut bool,
) -> Code {
    call(|| {
        // SAFETY: the caller's promise.
        let index = unsafe { index_of(index) }?;
        check_width(index, width)?;
        let point = index.get(id)?;
        // SAFETY: the caller's promise.
        unsafe {
            if let Some(point) = &point {
                copy(&[point.tag], tag);
                copy(&point.state, state);
            }
            put(point.is_some(), found, "found")
        }
    })
}

/// Forgets all points of an index in memory; their ids stay used. Fails for the other forms.
///
/// Thread-safe.
///
/// # Safety
/// `index` is a handle.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn wayfold_index_clear(index: *const WayfoldIndex) -> Code {
    call(|| {
        // SAFETY: the caller's promise.
        unsafe { index_of(index) }?.clear()?;
        Ok(())
    })
}

/// Removes all points that the index has now, for everybody: it reads all their ids first.
///
/// Thread-safe.
///
/// # Safety
/// `index` is a handle.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn wayfold_index_remove_all(index: *const WayfoldIndex) -> Code {
    call(|| {
        // SAFETY: the caller's promise.
        unsafe { index_of(index) }?.remove_all()?;
        Ok(())
    })
}

/// Changes a point, and writes whether there is one.
///
/// # Safety
/// `index` is a handle; `done` can be written or is null.
unsafe fn change(
    index: *const WayfoldIndex,
    done: *mut bool,
    change: impl FnOnce(&Index) -> Result<bool, Failure>,
) -> Code {
    call(|| {
        // SAFETY: the caller's promise.
        let was_there = change(unsafe { index_of(index) }?)?;
        // SAFETY: the caller's promise.
        unsafe { copy(&[was_there], done) };
        Ok(())
    })
}
