//! The library, and an index from its making to its end.

use std::ffi::c_char;

use client::Index;

use super::pointers::{copy, give, index_of, parse_space, put, rows, text};
use crate::{
    code::Code,
    failure::{Failure, call, free, last, last_rows_done},
    options::{WayfoldPoint, WayfoldSearch},
};

/// A dynamic set of states with exact nearest-neighbour search.
pub struct WayfoldIndex(pub(super) Index);

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
    last(|failure| &failure.message)
}

/// The field that the last error is about, as in "states[3].coords[1]"; "" if it is about none.
///
/// Thread-safe: each thread has its own.
#[unsafe(no_mangle)]
pub extern "C" fn wayfold_error_field() -> *const c_char {
    last(|failure| &failure.field)
}

/// The reason of the last error in UPPER_SNAKE_CASE, as in "INVALID_STATE"; "" if it has none.
///
/// Thread-safe: each thread has its own.
#[unsafe(no_mangle)]
pub extern "C" fn wayfold_error_reason() -> *const c_char {
    last(|failure| &failure.reason)
}

/// The number of rows that took effect before the last error, whose reason is "PARTIAL" then. 0 means that the reason is
/// another one.
///
/// Thread-safe: each thread has its own.
#[unsafe(no_mangle)]
pub extern "C" fn wayfold_error_rows_done() -> usize {
    last_rows_done()
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

/// Makes an empty index in this process. `space` is a text such as "R3*SO3:0.15" or "sum(R3, SO3)". Two threads of the
/// process, which all indices share, merge the index's trees. With `inline_merges` no thread is started: an insert that
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

/// Writes the first `capacity` bytes of the text of the index's space, as in "R3*SO3:0.15", and the number of all its
/// bytes. Equal spaces have equal texts.
///
/// Thread-safe.
///
/// # Safety
/// `text` has room for `capacity` bytes; `text_bytes` can be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn wayfold_index_space(
    index: *const WayfoldIndex,
    text: *mut c_char,
    capacity: usize,
    text_bytes: *mut usize,
) -> Code {
    call(|| {
        // SAFETY: the caller's promise.
        let space = unsafe { index_of(index) }?.space().to_string();
        // SAFETY: the caller's promise.
        unsafe {
            copy(&space.as_bytes()[..space.len().min(capacity)], text.cast());
            put(space.len(), text_bytes, "text_bytes")
        }
    })
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

/// Writes the distance of two states of the index's space. The error about a number of `a` calls it `states[0]`, and
/// that about one of `b` calls it `states[1]`.
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
        let index = unsafe { index_of(index) }?;
        // SAFETY: the caller's promise.
        let (a, b) = unsafe {
            (
                rows(index, a, 1, width, "a")?,
                rows(index, b, 1, width, "b")?,
            )
        };
        let space = index.space();
        let canonical = |row: usize, state: &[f64]| {
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
