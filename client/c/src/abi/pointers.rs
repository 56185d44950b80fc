//! The checks of the pointers and numbers of a caller.

use std::{
    ffi::{CStr, c_char},
    slice,
};

use client::{Index, Space};

use super::index::WayfoldIndex;
use crate::{code::Code, failure::Failure};

pub(super) fn check_width(index: &Index, width: usize) -> Result<(), Failure> {
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

pub(super) fn parse_space(text: &str) -> Result<Space, Failure> {
    let parsed = text.parse::<Space>();
    parsed.map_err(|error| {
        let message = error.to_string();
        Failure::new(Code::InvalidArgument, "space", "INVALID_SPACE", &message)
    })
}

pub(super) fn product(count: usize, width: usize) -> Result<usize, Failure> {
    let numbers = count.checked_mul(width);
    numbers
        .filter(|&numbers| fits::<f64>(numbers))
        .ok_or_else(|| too_many("count"))
}

/// The error of a number of states, or of a capacity, for which no buffer is large enough.
pub(super) fn too_many(field: &str) -> Failure {
    Failure::argument(field, "more numbers than memory can hold")
}

/// A slice has at most `isize::MAX` bytes.
fn fits<T>(count: usize) -> bool {
    count
        .checked_mul(size_of::<T>())
        .is_some_and(|bytes| isize::try_from(bytes).is_ok())
}

pub(super) fn null(field: &str) -> Failure {
    Failure::new(
        Code::InvalidArgument,
        field,
        "NULL_POINTER",
        &format!("{field}: a null pointer"),
    )
}

/// # Safety
/// `index` is a handle or null.
pub(super) unsafe fn index_of<'a>(index: *const WayfoldIndex) -> Result<&'a Index, Failure> {
    // SAFETY: the caller's promise.
    let index = unsafe { index.as_ref() };
    index.map(|index| &index.0).ok_or_else(|| null("index"))
}

/// # Safety
/// `index` can be written or is null.
pub(super) unsafe fn give(made: Index, index: *mut *mut WayfoldIndex) -> Result<(), Failure> {
    if index.is_null() {
        return Err(null("index"));
    }
    // SAFETY: the caller's promise.
    unsafe { index.write(Box::into_raw(Box::new(WayfoldIndex(made)))) };
    Ok(())
}

/// # Safety
/// `pointer` is a string that ends with 0, or null.
pub(super) unsafe fn text<'a>(pointer: *const c_char, field: &str) -> Result<&'a str, Failure> {
    if pointer.is_null() {
        return Err(null(field));
    }
    // SAFETY: the caller's promise.
    let text = unsafe { CStr::from_ptr(pointer) }.to_str();
    text.map_err(|_| Failure::argument(field, "not UTF-8"))
}

/// The rows of `count` states.
///
/// # Safety
/// `states` has `count × width` numbers or is null.
pub(super) unsafe fn rows<'a>(
    index: &Index,
    states: *const f64,
    count: usize,
    width: usize,
    field: &str,
) -> Result<&'a [f64], Failure> {
    check_width(index, width)?;
    // SAFETY: the caller's promise.
    unsafe { values(states, product(count, width)?, field) }
}

/// # Safety
/// `pointer` has `count` values or is null.
pub(super) unsafe fn values<'a, T>(
    pointer: *const T,
    count: usize,
    field: &str,
) -> Result<&'a [T], Failure> {
    match (pointer.is_null(), count) {
        (_, 0) => Ok(&[]),
        (true, _) => Err(null(field)),
        (false, _) if !fits::<T>(count) => {
            Err(Failure::argument(field, "more than memory can hold"))
        }
        // SAFETY: the caller's promise; the length fits a slice.
        (false, _) => Ok(unsafe { slice::from_raw_parts(pointer, count) }),
    }
}

/// Writes a value that the caller needs.
///
/// # Safety
/// `out` can be written or is null.
pub(super) unsafe fn put<T>(value: T, out: *mut T, field: &str) -> Result<(), Failure> {
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
pub(super) unsafe fn copy<T: Copy>(values: &[T], out: *mut T) {
    if !out.is_null() {
        // SAFETY: the caller's promise; the library's values lie in its own memory.
        unsafe { out.copy_from_nonoverlapping(values.as_ptr(), values.len()) };
    }
}
