//! The connection of a shared index: its state, its end, and the writes that the server did not take.

use std::{ffi::c_char, ptr, time::Duration};

use client::{ConnectionStatus, Error, Index, UnsentWrite};

use super::{
    index::WayfoldIndex,
    pointers::{copy, index_of, put},
};
use crate::{
    code::Code,
    failure::{Failure, call},
};

/// The state of a shared index's connection to its server.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum WayfoldStatus {
    /// The index has another form.
    NotShared = 0,
    /// Writes of others are applied as they arrive.
    Following = 1,
    /// The copy reads all points again. Reads see the old points and own writes.
    Reloading = 2,
    /// There is no connection, and the index tries to get one. Reads go on, and writes wait in memory.
    Disconnected = 3,
    /// The server refused a write for good. Reads go on; writes fail until `wayfold_index_take_unsent`.
    Refused = 4,
    /// The index is gone, or has another space: reads and writes fail.
    Ended = 5,
    /// `wayfold_index_close` was called.
    Closed = 6,
    /// A state that this version has no name for.
    Unknown = 7,
}

/// The kind of a write.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum WayfoldUnsentKind {
    /// A point was stored.
    Put = 0,
    /// A point got another state.
    Replace = 1,
    /// A point was removed.
    Remove = 2,
    /// A point got a tag.
    SetTag = 3,
    /// A point got a payload.
    SetPayload = 4,
}

/// A write that was not sent, or that the server refused. Its columns are valid until the writes are freed.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct WayfoldUnsentWrite {
    /// The kind.
    pub kind: WayfoldUnsentKind,
    /// The id of the point.
    pub id: u64,
    /// The tag of `PUT` and `SET_TAG`.
    pub tag: u64,
    /// The canonical state of `PUT` and `REPLACE`, as many numbers as the space has; null for the others.
    pub state: *const f64,
    /// The payload of `PUT` and `SET_PAYLOAD`.
    pub payload: *const u8,
    /// Its bytes.
    pub payload_bytes: usize,
}

/// Writes that were not sent, or that the server refused.
pub struct WayfoldUnsent(Vec<UnsentWrite>);

/// The index of a handle. A shared one of a process before a fork is refused: it would answer that it has no writes.
///
/// # Safety
/// `index` is a handle or null.
pub(super) unsafe fn unforked_index_of<'a>(
    index: *const WayfoldIndex,
) -> Result<&'a Index, Failure> {
    // SAFETY: the caller's promise.
    let index = unsafe { index_of(index) }?;
    match index.status() {
        Some(ConnectionStatus::Ended { why }) if matches!(*why, Error::Forked) => {
            Err(Failure::from(Error::Forked))
        }
        _ => Ok(index),
    }
}

/// Writes the state of a shared index's connection. `behind` gets the number of revisions by which the server was ahead
/// when it last sent something, of `FOLLOWING`. `why` gets the first `capacity` bytes of the error of `DISCONNECTED`,
/// `REFUSED` and `ENDED`, and `why_bytes` the number of all its bytes. `behind` may be null.
///
/// Thread-safe.
///
/// # Safety
/// `index` is a handle; `status` and `why_bytes` can be written, and `behind` or it is null; `why` has room for
/// `capacity` bytes.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn wayfold_index_status(
    index: *const WayfoldIndex,
    status: *mut WayfoldStatus,
    behind: *mut u64,
    why: *mut c_char,
    capacity: usize,
    why_bytes: *mut usize,
) -> Code {
    call(|| {
        // SAFETY: the caller's promise.
        let (name, revisions_behind, cause) = match unsafe { index_of(index) }?.status() {
            None => (WayfoldStatus::NotShared, 0, None),
            Some(ConnectionStatus::Following { behind }) => {
                (WayfoldStatus::Following, behind, None)
            }
            Some(ConnectionStatus::Reloading) => (WayfoldStatus::Reloading, 0, None),
            Some(ConnectionStatus::Disconnected { why, .. }) => {
                (WayfoldStatus::Disconnected, 0, Some(why))
            }
            Some(ConnectionStatus::Refused { why }) => (WayfoldStatus::Refused, 0, Some(why)),
            Some(ConnectionStatus::Ended { why }) => (WayfoldStatus::Ended, 0, Some(why)),
            Some(ConnectionStatus::Closed) => (WayfoldStatus::Closed, 0, None),
            Some(_) => (WayfoldStatus::Unknown, 0, None),
        };
        let cause = cause.map_or_else(String::new, |cause| cause.to_string());
        // SAFETY: the caller's promise.
        unsafe {
            copy(&[revisions_behind], behind);
            copy(&cause.as_bytes()[..cause.len().min(capacity)], why.cast());
            put(cause.len(), why_bytes, "why_bytes")?;
            put(name, status, "status")
        }
    })
}

/// Reads every write from the first one on that the server refused for good, in order; the copy shows them no more. The
/// index takes writes again then. Free them with `wayfold_unsent_free`.
///
/// The server may have taken the first batch of them: after the reconnection look whether its points are there. Store a
/// put again without its id if the index assigned it: the id stays reserved for the session that ended.
///
/// Thread-safe.
///
/// # Safety
/// `index` is a handle; `unsent` can be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn wayfold_index_take_unsent(
    index: *const WayfoldIndex,
    unsent: *mut *mut WayfoldUnsent,
) -> Code {
    // SAFETY: the caller's promise.
    unsafe { give_unsent(index, unsent, Index::take_unsent) }
}

/// Takes no more writes of a shared index, waits for the pending ones, at most for `timeout_ms`, and reads those that the
/// server has not acknowledged: it may have taken the first of them. Free them with `wayfold_unsent_free`.
///
/// Thread-safe.
///
/// # Safety
/// `index` is a handle; `unsent` can be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn wayfold_index_close(
    index: *const WayfoldIndex,
    timeout_ms: u64,
    unsent: *mut *mut WayfoldUnsent,
) -> Code {
    let timeout = Duration::from_millis(timeout_ms);
    // SAFETY: the caller's promise.
    unsafe { give_unsent(index, unsent, |index| index.close(timeout)) }
}

/// # Safety
/// `index` is a handle or null; `unsent` can be written or is null.
unsafe fn give_unsent(
    index: *const WayfoldIndex,
    unsent: *mut *mut WayfoldUnsent,
    take: impl FnOnce(&Index) -> Vec<UnsentWrite>,
) -> Code {
    call(|| {
        // SAFETY: the caller's promise. Null at first: a pointer that cannot be written loses no writes.
        unsafe { put(ptr::null_mut(), unsent, "unsent") }?;
        // SAFETY: the caller's promise.
        let taken = WayfoldUnsent(take(unsafe { unforked_index_of(index) }?));
        // SAFETY: the caller's promise.
        unsafe { put(Box::into_raw(Box::new(taken)), unsent, "unsent") }
    })
}

/// The number of writes. Thread-safe.
///
/// # Safety
/// `unsent` is a handle.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn wayfold_unsent_count(unsent: *const WayfoldUnsent) -> usize {
    // SAFETY: the caller's promise.
    unsafe { unsent.as_ref() }.map_or(0, |unsent| unsent.0.len())
}

/// Writes one write; false if there is none at this position. Thread-safe.
///
/// # Safety
/// `unsent` is a handle; `write` can be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn wayfold_unsent_get(
    unsent: *const WayfoldUnsent,
    at: usize,
    write: *mut WayfoldUnsentWrite,
) -> bool {
    // SAFETY: the caller's promise.
    let one = unsafe { unsent.as_ref() }.and_then(|unsent| unsent.0.get(at));
    if let Some(one) = one {
        // SAFETY: the caller's promise.
        unsafe { copy(&[one.into()], write) };
    }
    one.is_some()
}

/// Frees writes; null is ignored. No other thread may use them during this call or after it.
///
/// # Safety
/// `unsent` is a handle that is not freed.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn wayfold_unsent_free(unsent: *mut WayfoldUnsent) {
    if !unsent.is_null() {
        // SAFETY: made of a box, and the caller promises that it is not freed.
        drop(unsafe { Box::from_raw(unsent) });
    }
}

impl From<&UnsentWrite> for WayfoldUnsentWrite {
    fn from(write: &UnsentWrite) -> WayfoldUnsentWrite {
        use WayfoldUnsentKind as Kind;
        let none: (&[f64], &[u8]) = (&[], &[]);
        let (kind, id, tag, (state, payload)) = match write {
            UnsentWrite::Put {
                id,
                tag,
                state,
                payload,
            } => (Kind::Put, *id, *tag, (&state[..], &payload[..])),
            UnsentWrite::Replace { id, state } => (Kind::Replace, *id, 0, (&state[..], none.1)),
            UnsentWrite::Remove { id } => (Kind::Remove, *id, 0, none),
            UnsentWrite::SetTag { id, tag } => (Kind::SetTag, *id, *tag, none),
            UnsentWrite::SetPayload { id, payload } => {
                (Kind::SetPayload, *id, 0, (none.0, &payload[..]))
            }
        };
        WayfoldUnsentWrite {
            kind,
            id,
            tag,
            state: match state.is_empty() {
                true => ptr::null(),
                false => state.as_ptr(),
            },
            payload: payload.as_ptr(),
            payload_bytes: payload.len(),
        }
    }
}
