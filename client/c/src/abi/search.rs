//! The functions that search.

use std::cell::Cell;

use client::{Index, Neighbor, ReadRevision, Search, SearchResult};

use super::{
    index::WayfoldIndex,
    pointers::{copy, index_of, null, product, put, rows},
};
use crate::{
    code::Code,
    failure::{Failure, call},
    options::WayfoldSearch,
};

thread_local! {
    /// The neighbours of the state that this thread asks about.
    static FOUND: Cell<Vec<Neighbor>> = const { Cell::new(Vec::new()) };
}

/// Writes the id and the distance of the nearest point, or false to `found` if there are no points.
///
/// Thread-safe.
///
/// # Safety
/// `state` has `width` numbers; `id`, `distance` and `found` can be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn wayfold_index_nearest(
    index: *const WayfoldIndex,
    state: *const f64,
    width: usize,
    id: *mut u64,
    distance: *mut f64,
    found: *mut bool,
) -> Code {
    call(|| {
        // SAFETY: the caller's promise.
        let index = unsafe { index_of(index) }?;
        // SAFETY: the caller's promise.
        let row = unsafe { rows(index, state, 1, width, "state") }?;
        let nearest = index.nearest(row)?;
        // SAFETY: the caller's promise.
        unsafe {
            if let Some(nearest) = nearest {
                put(nearest.id, id, "id")?;
                put(nearest.distance, distance, "distance")?;
            }
            put(nearest.is_some(), found, "found")
        }
    })
}

/// Answers a search of `count` states. Row i of `ids` and `distances`, of `capacity` numbers, gets the neighbours of
/// state i, nearest first and at equal distances by id; `found[i]` is their number. If it exceeds `capacity`, the row has
/// the nearest `capacity` of them. The rest of a row keeps its content. `ids` and `distances` may be null, and without a
/// state `found` too.
/// `read_revision` gets the revision that the answer read, for `since` of a later search, and the oldest one if a remote
/// index divided the states among calls; it may be null, and keeps its content without a state.
///
/// Thread-safe.
///
/// # Safety
/// `states` has `count × width` numbers; `ids` and `distances` have room for `count × capacity`, `found` for `count`;
/// `read_revision` can be written or is null.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn wayfold_index_search(
    index: *const WayfoldIndex,
    states: *const f64,
    count: usize,
    width: usize,
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
        let rows = unsafe { rows(index, states, count, width, "states") }?;
        // SAFETY: the caller's promise.
        let search = unsafe { search.as_ref() }
            .ok_or_else(|| null("search"))?
            .search();
        product(count, capacity)?;
        if count > 0 && found.is_null() {
            return Err(null("found"));
        }
        if count == 1 {
            return search_one(index, rows, &search, |neighbors, revision| {
                // SAFETY: the caller's promise.
                unsafe {
                    write_neighbors(neighbors, capacity, ids, distances);
                    found.write(neighbors.len());
                    copy(&[revision.0], read_revision);
                }
            });
        }
        let answers = index.search_many(rows.chunks_exact(width), &search)?;
        if let Some(oldest) = answers.iter().map(|it| it.read_revision).min() {
            // SAFETY: the caller's promise.
            unsafe { copy(&[oldest.0], read_revision) };
        }
        for (row, SearchResult { neighbors, .. }) in answers.iter().enumerate() {
            let at = row * capacity;
            // SAFETY: the caller's promise; a null pointer stays null.
            unsafe {
                let ids = if ids.is_null() { ids } else { ids.add(at) };
                let distances = if distances.is_null() {
                    distances
                } else {
                    distances.add(at)
                };
                write_neighbors(neighbors, capacity, ids, distances);
                found.add(row).write(neighbors.len());
            }
        }
        Ok(())
    })
}

/// Searches with this thread's buffer, or at the thread's end, when it is gone, with a new one.
fn search_one(
    index: &Index,
    row: &[f64],
    search: &Search,
    write: impl FnOnce(&[Neighbor], ReadRevision),
) -> Result<(), Failure> {
    let mut found = FOUND.try_with(Cell::take).unwrap_or_default();
    let searched = index.search_into(row, search, &mut found);
    if let Ok(read_revision) = searched {
        write(&found, read_revision);
    }
    let _ = FOUND.try_with(|buffer| buffer.set(found));
    searched?;
    Ok(())
}

/// # Safety
/// `ids` and `distances` have room for `capacity` each or are null.
pub(super) unsafe fn write_neighbors(
    neighbors: &[Neighbor],
    capacity: usize,
    ids: *mut u64,
    distances: *mut f64,
) {
    for (at, neighbor) in neighbors.iter().take(capacity).enumerate() {
        // SAFETY: `at` is below the capacity; the rest is the caller's promise.
        unsafe {
            if !ids.is_null() {
                ids.add(at).write(neighbor.id);
            }
            if !distances.is_null() {
                distances.add(at).write(neighbor.distance);
            }
        }
    }
}
