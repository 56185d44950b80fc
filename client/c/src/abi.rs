//! The functions of the ABI for all forms of an index, and the checks of the pointers that they get.
//!
//! A handle may be used by several threads at once, except in the function that frees it. States are rows of
//! `count × width` numbers; `width` is checked against the space. Results are copied into the caller's buffers once.

#![expect(
    unsafe_code,
    reason = "C hands over pointers, which Rust cannot check beyond null"
)]

use std::{
    cell::Cell,
    ffi::{CStr, c_char},
    slice,
};

use client::{Index, InsertOptions, Neighbor, Search, Space};

use crate::{
    code::Code,
    failure::{Failure, Part, call, free, last},
    options::{WayfoldPoint, WayfoldSearch},
};

/// A dynamic set of states with exact nearest-neighbour search.
pub struct WayfoldIndex(pub(crate) Index);

/// Points of an index, and ids that were removed from it.
pub struct WayfoldPoints {
    ids: Vec<u64>,
    tags: Vec<u64>,
    rows: Vec<f64>,
    removed: Vec<u64>,
    seen: u64,
}

thread_local! {
    /// The neighbours of the state that this thread asks about.
    static FOUND: Cell<Vec<Neighbor>> = const { Cell::new(Vec::new()) };
}

/// The version of the library, as in "0.1.0".
///
/// Thread-safe.
#[unsafe(no_mangle)]
pub extern "C" fn wayfold_version() -> *const c_char {
    concat!(env!("CARGO_PKG_VERSION"), "\0").as_ptr().cast()
}

/// The message of the error of this thread's last failed call; "" if none has failed. It is valid until the next call
/// of this thread that fails.
///
/// Thread-safe: each thread has its own.
#[unsafe(no_mangle)]
pub extern "C" fn wayfold_error_message() -> *const c_char {
    last(Part::Message)
}

/// The field that the last error is about, as in "states[3].coords[1]"; "" if it is about none.
///
/// Thread-safe: each thread has its own.
#[unsafe(no_mangle)]
pub extern "C" fn wayfold_error_field() -> *const c_char {
    last(Part::Field)
}

/// The reason of the last error in UPPER_SNAKE_CASE, as in "INVALID_STATE"; "" if it has none.
///
/// Thread-safe: each thread has its own.
#[unsafe(no_mangle)]
pub extern "C" fn wayfold_error_reason() -> *const c_char {
    last(Part::Reason)
}

/// A search that finds all points.
///
/// Thread-safe.
#[unsafe(no_mangle)]
pub extern "C" fn wayfold_search_default() -> WayfoldSearch {
    WayfoldSearch::ALL
}

/// A point whose id the index assigns, with tag 0 and no payload.
///
/// Thread-safe.
#[unsafe(no_mangle)]
pub extern "C" fn wayfold_point_default() -> WayfoldPoint {
    WayfoldPoint {
        id: u64::MAX,
        tag: 0,
        payload: std::ptr::null(),
        payload_bytes: 0,
    }
}

/// Makes an empty index in this process. `space` is a text such as "R3*SO3:0.15" or "sum(R3, SO3)". A thread of the
/// process, which all indices share, merges the index's trees. With `inline_merges` no thread is started: an insert that
/// makes a merge due runs it, and few inserts take long.
///
/// Thread-safe.
///
/// # Safety
/// `space` is a string that ends with 0; `index` can be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn wayfold_index_in_memory(
    space: *const c_char,
    inline_merges: bool,
    index: *mut *mut WayfoldIndex,
) -> Code {
    call(|| {
        // SAFETY: the caller's promise.
        let space = parse_space(unsafe { text(space, "space") }?)?;
        let made = match inline_merges {
            false => Index::in_memory(&space)?,
            true => Index::in_memory_inline(&space)?,
        };
        // SAFETY: the caller's promise.
        unsafe { give(made, index) }
    })
}

/// Frees an index; null is ignored. A shared index stops following its server: call `wayfold_index_close` first to wait
/// for its writes.
///
/// No other thread may use the handle during this call or after it.
///
/// # Safety
/// `index` is a handle that is not freed.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn wayfold_index_free(index: *mut WayfoldIndex) {
    if !index.is_null() {
        // SAFETY: `give` made it of a box, and the caller promises that it is not freed.
        let index = unsafe { Box::from_raw(index) };
        free(|| drop(index));
    }
}

/// The numbers of a state: the coordinates of the space. 0 for a null handle.
///
/// Thread-safe.
///
/// # Safety
/// `index` is a handle, or null.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn wayfold_index_width(index: *const WayfoldIndex) -> usize {
    // SAFETY: the caller's promise.
    unsafe { index.as_ref() }.map_or(0, |index| index.0.space().coordinates())
}

/// Writes the number of points.
///
/// Thread-safe.
///
/// # Safety
/// `index` is a handle; `size` can be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn wayfold_index_size(index: *const WayfoldIndex, size: *mut usize) -> Code {
    call(|| {
        // SAFETY: the caller's promise.
        unsafe { put(index_of(index)?.len()?, size, "size") }
    })
}

/// Writes the distance of two states of the index's space.
///
/// Thread-safe.
///
/// # Safety
/// `a` and `b` have `width` numbers each; `distance` can be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn wayfold_index_distance(
    index: *const WayfoldIndex,
    a: *const f64,
    b: *const f64,
    width: usize,
    distance: *mut f64,
) -> Code {
    call(|| {
        // SAFETY: the caller's promise.
        let (index, a, b) = unsafe {
            (
                index_of(index)?,
                numbers(a, width, "a")?,
                numbers(b, width, "b")?,
            )
        };
        let space = index.space();
        let canonical = |row: usize, state: &[f64]| {
            check_width(index, width)?;
            let mut state = state.to_vec();
            let checked = space.canonicalize(&mut state);
            checked.map_err(|error| client::Error::State { row, error })?;
            Ok::<_, Failure>(state)
        };
        let between = space.distance(&canonical(0, a)?, &canonical(1, b)?);
        // SAFETY: the caller's promise.
        unsafe { put(between, distance, "distance") }
    })
}

/// Stores `count` states, all or none in memory, and writes their ids, which ascend; `ids` may be null.
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
        let (index, rows) = unsafe {
            (
                index_of(index)?,
                numbers(states, product(count, width)?, "states")?,
            )
        };
        if count == 1 {
            let id = index.insert(rows)?;
            // SAFETY: the caller's promise.
            unsafe { copy(&[id], ids) };
        } else {
            check_width(index, width)?;
            let stored = index.insert_many(rows.chunks_exact(width))?;
            // SAFETY: the caller's promise.
            unsafe { copy(&stored, ids) };
        }
        Ok(())
    })
}

/// Stores a state with a tag, a payload or an id, and writes its id; `id` may be null. `search` may be null; otherwise
/// the neighbours that the state had at its insertion are written as by `wayfold_index_search`.
///
/// Thread-safe.
///
/// # Safety
/// `state` has `width` numbers; `ids` and `distances` have room for `capacity` if they are not null; `found` can be
/// written if `search` is not null.
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
) -> Code {
    call(|| {
        // SAFETY: the caller's promise.
        let (index, row) = unsafe { (index_of(index)?, numbers(state, width, "state")?) };
        // SAFETY: the caller's promise.
        let point = unsafe { point.as_ref() }.ok_or_else(|| null("point"))?;
        // SAFETY: the caller's promise.
        let payload = unsafe { bytes(point.payload, point.payload_bytes, "payload") }?;
        let mut options = InsertOptions::new().tag(point.tag).payload(payload);
        if point.id != u64::MAX {
            options = options.id(point.id);
        }
        // SAFETY: the caller's promise.
        let search = unsafe { search.as_ref() }.map(WayfoldSearch::search);
        if let Some(search) = search {
            options = options.ask(search);
        }
        let inserted = index.insert_with(row, options)?;
        // SAFETY: the caller's promise.
        unsafe {
            copy(&[inserted.id], id);
            if search.is_some() {
                let neighbors = &inserted.found.neighbors;
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
    call(|| {
        // SAFETY: the caller's promise.
        unsafe {
            let was_there = index_of(index)?.remove(id)?;
            copy(&[was_there], removed);
        }
        Ok(())
    })
}

/// Moves the point with this id to another state; it keeps its tag and loses its payload. Writes false if there is none.
/// `replaced` may be null.
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
    call(|| {
        // SAFETY: the caller's promise.
        unsafe {
            let was_there = index_of(index)?.replace(id, numbers(state, width, "state")?)?;
            copy(&[was_there], replaced);
        }
        Ok(())
    })
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
    call(|| {
        // SAFETY: the caller's promise.
        unsafe {
            let was_there = index_of(index)?.set_tag(id, tag)?;
            copy(&[was_there], set);
        }
        Ok(())
    })
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
    call(|| {
        // SAFETY: the caller's promise.
        unsafe {
            let payload = bytes(payload, payload_bytes, "payload")?;
            let was_there = index_of(index)?.set_payload(id, payload)?;
            copy(&[was_there], set);
        }
        Ok(())
    })
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

/// Writes the first `capacity` bytes of the payload of the point with this id, and the number of all its bytes. No bytes
/// if there is no such point; `wayfold_index_get` tells.
///
/// Thread-safe.
///
/// # Safety
/// `payload` has room for `capacity` bytes; `payload_bytes` can be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn wayfold_index_payload(
    index: *const WayfoldIndex,
    id: u64,
    payload: *mut u8,
    capacity: usize,
    payload_bytes: *mut usize,
) -> Code {
    call(|| {
        // SAFETY: the caller's promise.
        let held = unsafe { index_of(index) }?.payload(id)?.unwrap_or_default();
        // SAFETY: the caller's promise.
        unsafe {
            copy(&held[..held.len().min(capacity)], payload);
            put(held.len(), payload_bytes, "payload_bytes")
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
        let (index, row) = unsafe { (index_of(index)?, numbers(state, width, "state")?) };
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
/// the nearest `capacity` of them. The rest of a row keeps its content. `ids` and `distances` may be null.
///
/// Thread-safe.
///
/// # Safety
/// `states` has `count × width` numbers; `ids` and `distances` have room for `count × capacity`, `found` for `count`.
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
) -> Code {
    call(|| {
        // SAFETY: the caller's promise.
        let (index, rows) = unsafe {
            (
                index_of(index)?,
                numbers(states, product(count, width)?, "states")?,
            )
        };
        // SAFETY: the caller's promise.
        let search = unsafe { search.as_ref() }
            .ok_or_else(|| null("search"))?
            .search();
        product(count, capacity)?;
        if found.is_null() {
            return Err(null("found"));
        }
        if count == 1 {
            return search_one(index, rows, &search, |neighbors| {
                // SAFETY: the caller's promise.
                unsafe {
                    write_neighbors(neighbors, capacity, ids, distances);
                    found.write(neighbors.len());
                }
            });
        }
        check_width(index, width)?;
        let answers = index.search_many(rows.chunks_exact(width), &search)?;
        for (row, neighbors) in answers.iter().enumerate() {
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

/// Reads all points, by ascending id. Free them with `wayfold_points_free`.
///
/// Thread-safe.
///
/// # Safety
/// `index` is a handle; `points` can be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn wayfold_index_scan(
    index: *const WayfoldIndex,
    points: *mut *mut WayfoldPoints,
) -> Code {
    call(|| {
        let mut all = WayfoldPoints::empty(0);
        // SAFETY: the caller's promise.
        for point in unsafe { index_of(index) }?.scan()? {
            all.push(&point?);
        }
        // SAFETY: the caller's promise.
        unsafe { put(Box::into_raw(Box::new(all)), points, "points") }
    })
}

/// Reads the points that were stored or changed after an answer that has seen this much, 0 for all, and the ids that
/// were removed. Writes null if the index has forgotten some of it, as after 65,536 changes: scan it then.
///
/// Thread-safe.
///
/// # Safety
/// `index` is a handle; `points` can be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn wayfold_index_changes(
    index: *const WayfoldIndex,
    seen: u64,
    points: *mut *mut WayfoldPoints,
) -> Code {
    call(|| {
        // SAFETY: the caller's promise.
        let changes = unsafe { index_of(index) }?.changes(client::Seen(seen))?;
        let made = changes.map_or(std::ptr::null_mut(), |changes| {
            let mut some = WayfoldPoints::empty(changes.seen.0);
            changes.stored.iter().for_each(|point| some.push(point));
            some.removed = changes.removed;
            Box::into_raw(Box::new(some))
        });
        // SAFETY: the caller's promise.
        unsafe { put(made, points, "points") }
    })
}

/// The number of points. Thread-safe.
///
/// # Safety
/// `points` is a handle.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn wayfold_points_count(points: *const WayfoldPoints) -> usize {
    // SAFETY: the caller's promise.
    unsafe { points.as_ref() }.map_or(0, |points| points.ids.len())
}

/// The ids of the points, valid until the points are freed. Thread-safe.
///
/// # Safety
/// `points` is a handle.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn wayfold_points_ids(points: *const WayfoldPoints) -> *const u64 {
    // SAFETY: the caller's promise.
    unsafe { points.as_ref() }.map_or(std::ptr::null(), |points| points.ids.as_ptr())
}

/// The tags of the points, valid until the points are freed. Thread-safe.
///
/// # Safety
/// `points` is a handle.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn wayfold_points_tags(points: *const WayfoldPoints) -> *const u64 {
    // SAFETY: the caller's promise.
    unsafe { points.as_ref() }.map_or(std::ptr::null(), |points| points.tags.as_ptr())
}

/// The states of the points, one after the other, valid until the points are freed. Thread-safe.
///
/// # Safety
/// `points` is a handle.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn wayfold_points_states(points: *const WayfoldPoints) -> *const f64 {
    // SAFETY: the caller's promise.
    unsafe { points.as_ref() }.map_or(std::ptr::null(), |points| points.rows.as_ptr())
}

/// The removed ids, valid until the points are freed; writes their number. Thread-safe.
///
/// # Safety
/// `points` is a handle; `count` can be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn wayfold_points_removed(
    points: *const WayfoldPoints,
    count: *mut usize,
) -> *const u64 {
    // SAFETY: the caller's promise.
    unsafe {
        let removed = points.as_ref().map_or(&[][..], |points| &points.removed);
        copy(&[removed.len()], count);
        removed.as_ptr()
    }
}

/// What these changes have seen: ask for the next ones with it. Thread-safe.
///
/// # Safety
/// `points` is a handle.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn wayfold_points_seen(points: *const WayfoldPoints) -> u64 {
    // SAFETY: the caller's promise.
    unsafe { points.as_ref() }.map_or(0, |points| points.seen)
}

/// Frees points; null is ignored. No other thread may use them during this call or after it.
///
/// # Safety
/// `points` is a handle that is not freed.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn wayfold_points_free(points: *mut WayfoldPoints) {
    if !points.is_null() {
        // SAFETY: made of a box, and the caller promises that it is not freed.
        drop(unsafe { Box::from_raw(points) });
    }
}

impl WayfoldPoints {
    fn empty(seen: u64) -> WayfoldPoints {
        WayfoldPoints {
            ids: Vec::new(),
            tags: Vec::new(),
            rows: Vec::new(),
            removed: Vec::new(),
            seen,
        }
    }

    fn push(&mut self, point: &client::StoredPoint) {
        self.ids.push(point.id);
        self.tags.push(point.tag);
        self.rows.extend_from_slice(&point.state);
    }
}

/// Searches with this thread's buffer.
fn search_one(
    index: &Index,
    row: &[f64],
    search: &Search,
    write: impl FnOnce(&[Neighbor]),
) -> Result<(), Failure> {
    let mut found = FOUND.take();
    let searched = index.search_into(row, search, &mut found);
    if searched.is_ok() {
        write(&found);
    }
    FOUND.set(found);
    searched?;
    Ok(())
}

fn check_width(index: &Index, width: usize) -> Result<(), Failure> {
    let expected = index.space().coordinates();
    match width == expected {
        true => Ok(()),
        false => Err(Failure::from(client::Error::Width {
            row: 0,
            expected,
            found: width,
        })),
    }
}

pub(crate) fn parse_space(text: &str) -> Result<Space, Failure> {
    let parsed = text.parse::<Space>();
    parsed.map_err(|error| {
        let message = error.to_string();
        Failure::new(Code::InvalidArgument, "space", "INVALID_SPACE", &message)
    })
}

fn product(count: usize, width: usize) -> Result<usize, Failure> {
    let numbers = count.checked_mul(width);
    // A slice has at most this many bytes.
    let fits = |numbers: &usize| *numbers <= isize::MAX as usize / 8;
    numbers
        .filter(fits)
        .ok_or_else(|| Failure::argument("count", "more numbers than memory can hold"))
}

fn null(field: &str) -> Failure {
    Failure::new(
        Code::InvalidArgument,
        field,
        "NULL_POINTER",
        &format!("{field}: a null pointer"),
    )
}

/// # Safety
/// `index` is a handle or null.
pub(crate) unsafe fn index_of<'a>(index: *const WayfoldIndex) -> Result<&'a Index, Failure> {
    // SAFETY: the caller's promise.
    let index = unsafe { index.as_ref() };
    index.map(|index| &index.0).ok_or_else(|| null("index"))
}

/// # Safety
/// `index` can be written or is null.
pub(crate) unsafe fn give(made: Index, index: *mut *mut WayfoldIndex) -> Result<(), Failure> {
    if index.is_null() {
        return Err(null("index"));
    }
    // SAFETY: the caller's promise.
    unsafe { index.write(Box::into_raw(Box::new(WayfoldIndex(made)))) };
    Ok(())
}

/// # Safety
/// `pointer` is a string that ends with 0, or null.
pub(crate) unsafe fn text<'a>(pointer: *const c_char, field: &str) -> Result<&'a str, Failure> {
    if pointer.is_null() {
        return Err(null(field));
    }
    // SAFETY: the caller's promise.
    let text = unsafe { CStr::from_ptr(pointer) }.to_str();
    text.map_err(|_| Failure::argument(field, "not UTF-8"))
}

/// # Safety
/// `pointer` has `count` numbers or is null.
unsafe fn numbers<'a>(
    pointer: *const f64,
    count: usize,
    field: &str,
) -> Result<&'a [f64], Failure> {
    match (pointer.is_null(), count) {
        (_, 0) => Ok(&[]),
        (true, _) => Err(null(field)),
        // SAFETY: the caller's promise.
        (false, _) => Ok(unsafe { slice::from_raw_parts(pointer, count) }),
    }
}

/// # Safety
/// `pointer` has `count` bytes or is null.
unsafe fn bytes<'a>(pointer: *const u8, count: usize, field: &str) -> Result<&'a [u8], Failure> {
    match (pointer.is_null(), count) {
        (_, 0) => Ok(&[]),
        (true, _) => Err(null(field)),
        // SAFETY: the caller's promise.
        (false, _) => Ok(unsafe { slice::from_raw_parts(pointer, count) }),
    }
}

/// Writes a value that the caller needs.
///
/// # Safety
/// `out` can be written or is null.
pub(crate) unsafe fn put<T>(value: T, out: *mut T, field: &str) -> Result<(), Failure> {
    if out.is_null() {
        return Err(null(field));
    }
    // SAFETY: the caller's promise.
    unsafe { out.write(value) };
    Ok(())
}

/// Copies values to a buffer, if there is one.
///
/// # Safety
/// `out` has room for the values or is null.
unsafe fn copy<T: Copy>(values: &[T], out: *mut T) {
    if !out.is_null() {
        // SAFETY: the caller's promise; the library's values lie in its own memory.
        unsafe { out.copy_from_nonoverlapping(values.as_ptr(), values.len()) };
    }
}

/// # Safety
/// `ids` and `distances` have room for `capacity` each or are null.
unsafe fn write_neighbors(
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
