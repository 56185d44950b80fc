//! The functions that search.

use std::{cell::Cell, ptr};

use client::{Index, Neighbor, ReadRevision, Search, SearchResult};

use super::{
    index::WayfoldIndex,
    pointers::{copy, index_of, null, product, put, rows, too_many},
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
/// state `found` too. `wayfold_index_search_many` needs no capacity.
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
        let has_buffer = !ids.is_null() || !distances.is_null();
        if has_buffer && product(count, capacity).is_err() {
            return Err(too_many("capacity"));
        }
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
        // SAFETY: the caller's promise.
        unsafe { write_oldest(&answers, read_revision) };
        for (row, SearchResult { neighbors, .. }) in answers.iter().enumerate() {
            // Without a buffer the product may be any number.
            let at = row.wrapping_mul(capacity);
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

/// The neighbours of many states.
pub struct WayfoldResults {
    /// The ends of the states' neighbours in the columns.
    ends: Vec<usize>,
    ids: Vec<u64>,
    distances: Vec<f64>,
}

/// Answers a search of `count` states, which see the same points, however many neighbours each of them has:
/// `wayfold_results_get` reads those of one state. `read_revision` is that of `wayfold_index_search`. Free the results
/// with `wayfold_results_free`.
///
/// Thread-safe.
///
/// # Safety
/// `states` has `count × width` numbers; `results` can be written; `read_revision` can be written or is null.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn wayfold_index_search_many(
    index: *const WayfoldIndex,
    states: *const f64,
    count: usize,
    width: usize,
    search: *const WayfoldSearch,
    results: *mut *mut WayfoldResults,
    read_revision: *mut u64,
) -> Code {
    call(|| {
        // SAFETY: the caller's promise. Null at first: a pointer that cannot be written costs no search.
        unsafe { put(ptr::null_mut(), results, "results") }?;
        // SAFETY: the caller's promise.
        let index = unsafe { index_of(index) }?;
        // SAFETY: the caller's promise.
        let rows = unsafe { rows(index, states, count, width, "states") }?;
        // SAFETY: the caller's promise.
        let search = unsafe { search.as_ref() }
            .ok_or_else(|| null("search"))?
            .search();
        let answers = index.search_many(rows.chunks_exact(width), &search)?;
        // SAFETY: the caller's promise.
        unsafe { write_oldest(&answers, read_revision) };
        let all = Box::into_raw(Box::new(WayfoldResults::of(answers)));
        // SAFETY: the caller's promise.
        unsafe { put(all, results, "results") }
    })
}

/// The number of the neighbours of the state at this position, and their ids and distances, nearest first and at equal
/// distances by id. Both are valid until the results are freed. 0 if there is no such state. Thread-safe.
///
/// # Safety
/// `results` is a handle; `ids` and `distances` can be written or are null.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn wayfold_results_get(
    results: *const WayfoldResults,
    at: usize,
    ids: *mut *const u64,
    distances: *mut *const f64,
) -> usize {
    // SAFETY: the caller's promise.
    let neighbors = unsafe { results.as_ref() }.and_then(|results| results.get(at));
    let (near_ids, near_distances) = neighbors.unwrap_or_default();
    // SAFETY: the caller's promise.
    unsafe {
        copy(&[near_ids.as_ptr()], ids);
        copy(&[near_distances.as_ptr()], distances);
    }
    near_ids.len()
}

/// Frees results; null is ignored. No other thread may use them during this call or after it.
///
/// # Safety
/// `results` is a handle that is not freed.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn wayfold_results_free(results: *mut WayfoldResults) {
    if !results.is_null() {
        // SAFETY: made of a box, and the caller promises that it is not freed.
        drop(unsafe { Box::from_raw(results) });
    }
}

impl WayfoldResults {
    fn of(answers: Vec<SearchResult>) -> WayfoldResults {
        let count = answers.iter().map(|answer| answer.neighbors.len()).sum();
        let mut all = WayfoldResults {
            ends: Vec::with_capacity(answers.len()),
            ids: Vec::with_capacity(count),
            distances: Vec::with_capacity(count),
        };
        for SearchResult { neighbors, .. } in answers {
            all.ids.extend(neighbors.iter().map(|near| near.id));
            let distances = neighbors.iter().map(|near| near.distance);
            all.distances.extend(distances);
            all.ends.push(all.ids.len());
        }
        all
    }

    /// The ids and the distances of the neighbours of one state.
    fn get(&self, at: usize) -> Option<(&[u64], &[f64])> {
        let end = *self.ends.get(at)?;
        let start = at.checked_sub(1).map_or(0, |before| self.ends[before]);
        Some((&self.ids[start..end], &self.distances[start..end]))
    }
}

/// Writes the oldest of the revisions that answers read, if there are any.
///
/// # Safety
/// `read_revision` can be written or is null.
unsafe fn write_oldest(answers: &[SearchResult], read_revision: *mut u64) {
    if let Some(oldest) = answers.iter().map(|it| it.read_revision).min() {
        // SAFETY: the caller's promise.
        unsafe { copy(&[oldest.0], read_revision) };
    }
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
