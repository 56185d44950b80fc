//! Lists of points: a scan, changes, and payloads.

use std::ptr;

use super::{
    index::WayfoldIndex,
    pointers::{copy, index_of, put, values},
};
use crate::{code::Code, failure::call};

/// Points of an index, and ids that were removed from it.
pub struct WayfoldPoints {
    ids: Vec<u64>,
    tags: Vec<u64>,
    rows: Vec<f64>,
    removed: Vec<u64>,
    read_revision: u64,
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
        // SAFETY: the caller's promise. Null at first: a pointer that cannot be written leaks no points.
        unsafe { put(ptr::null_mut(), points, "points") }?;
        let mut all = WayfoldPoints::empty(0);
        // SAFETY: the caller's promise.
        for point in unsafe { index_of(index) }?.scan()? {
            all.push(&point?);
        }
        // SAFETY: the caller's promise.
        unsafe { put(Box::into_raw(Box::new(all)), points, "points") }
    })
}

/// Reads the points that were stored or changed after the revision that an answer read, 0 for all, and the ids that
/// were removed. Writes null if the index has forgotten some of it, as after 65,536 changes: scan it then. `UINT64_MAX`
/// reads no point, only the revision of now; a remote index refuses it.
///
/// Thread-safe.
///
/// # Safety
/// `index` is a handle; `points` can be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn wayfold_index_changes(
    index: *const WayfoldIndex,
    since: u64,
    points: *mut *mut WayfoldPoints,
) -> Code {
    call(|| {
        // SAFETY: the caller's promise. Null at first, as above.
        unsafe { put(ptr::null_mut(), points, "points") }?;
        // SAFETY: the caller's promise.
        let changes = unsafe { index_of(index) }?.changes(client::ReadRevision(since))?;
        let made = changes.map_or(ptr::null_mut(), |changes| {
            let mut some = WayfoldPoints::empty(changes.read_revision.0);
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
    unsafe { points.as_ref() }.map_or(ptr::null(), |points| points.ids.as_ptr())
}

/// The tags of the points, valid until the points are freed. Thread-safe.
///
/// # Safety
/// `points` is a handle.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn wayfold_points_tags(points: *const WayfoldPoints) -> *const u64 {
    // SAFETY: the caller's promise.
    unsafe { points.as_ref() }.map_or(ptr::null(), |points| points.tags.as_ptr())
}

/// The states of the points, one after the other, valid until the points are freed. Thread-safe.
///
/// # Safety
/// `points` is a handle.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn wayfold_points_states(points: *const WayfoldPoints) -> *const f64 {
    // SAFETY: the caller's promise.
    unsafe { points.as_ref() }.map_or(ptr::null(), |points| points.rows.as_ptr())
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

/// The revision after these changes, for the next call of `wayfold_index_changes`. Thread-safe.
///
/// # Safety
/// `points` is a handle.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn wayfold_points_read_revision(points: *const WayfoldPoints) -> u64 {
    // SAFETY: the caller's promise.
    unsafe { points.as_ref() }.map_or(0, |points| points.read_revision)
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

/// Payloads of points.
pub struct WayfoldPayloads(Vec<Option<Vec<u8>>>);

/// Reads the payloads of the points with these ids: a shared index asks its server once for a thousand of
/// them. Free them with `wayfold_payloads_free`.
///
/// Thread-safe.
///
/// # Safety
/// `index` is a handle; `ids` has `count` ids; `payloads` can be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn wayfold_index_payloads(
    index: *const WayfoldIndex,
    ids: *const u64,
    count: usize,
    payloads: *mut *mut WayfoldPayloads,
) -> Code {
    call(|| {
        // SAFETY: the caller's promise. Null at first, as above.
        unsafe { put(ptr::null_mut(), payloads, "payloads") }?;
        // SAFETY: the caller's promise.
        let (index, ids) = unsafe { (index_of(index)?, values(ids, count, "ids")?) };
        let read = WayfoldPayloads(index.payloads(ids)?);
        // SAFETY: the caller's promise.
        unsafe { put(Box::into_raw(Box::new(read)), payloads, "payloads") }
    })
}

/// The payload of the id at this position, valid until the payloads are freed, and the number of its bytes. Null if the
/// index had no point with the id. Thread-safe.
///
/// # Safety
/// `payloads` is a handle; `payload_bytes` can be written or is null.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn wayfold_payloads_get(
    payloads: *const WayfoldPayloads,
    at: usize,
    payload_bytes: *mut usize,
) -> *const u8 {
    // SAFETY: the caller's promise.
    let payload = unsafe { payloads.as_ref() }.and_then(|payloads| payloads.0.get(at)?.as_deref());
    // SAFETY: the caller's promise.
    unsafe { copy(&[payload.map_or(0, <[u8]>::len)], payload_bytes) };
    payload.map_or(ptr::null(), <[u8]>::as_ptr)
}

/// Frees payloads; null is ignored. No other thread may use them during this call or after it.
///
/// # Safety
/// `payloads` is a handle that is not freed.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn wayfold_payloads_free(payloads: *mut WayfoldPayloads) {
    if !payloads.is_null() {
        // SAFETY: made of a box, and the caller promises that it is not freed.
        drop(unsafe { Box::from_raw(payloads) });
    }
}

impl WayfoldPoints {
    fn empty(read_revision: u64) -> WayfoldPoints {
        WayfoldPoints {
            ids: Vec::new(),
            tags: Vec::new(),
            rows: Vec::new(),
            removed: Vec::new(),
            read_revision,
        }
    }

    fn push(&mut self, point: &client::StoredPoint) {
        self.ids.push(point.id);
        self.tags.push(point.tag);
        self.rows.extend_from_slice(&point.state);
    }
}
