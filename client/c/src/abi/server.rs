//! The functions of the ABI for indices on a server.

use std::{ffi::c_char, time::Duration};

use client::{Credentials, Index};

use super::{
    index::WayfoldIndex,
    pointers::{give, index_of, null, parse_space, put, text},
};
use crate::{
    code::Code,
    failure::{Failure, call},
};

/// An index on a server.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct WayfoldServer {
    /// The server's address, as in "http://127.0.0.1:50051".
    pub uri: *const c_char,
    /// The index's name.
    pub name: *const c_char,
    /// Creates the index with this space if it is missing. Null: it must exist.
    pub space: *const c_char,
    /// The token of the caller, or null.
    pub token: *const c_char,
    /// The longest time of a call in milliseconds; 0 for the client's own, 30 s.
    pub timeout_ms: u64,
}

/// Opens an index: the builders of both forms have the same methods.
macro_rules! open {
    ($form:path, $settings:ident) => {{
        let settings: Settings<'_> = $settings;
        let mut open = $form(settings.uri, settings.name).credentials(settings.credentials);
        if let Some(space) = &settings.space {
            open = open.create(space);
        }
        if let Some(timeout) = settings.timeout {
            open = open.timeout(timeout);
        }
        open.open()?
    }};
}

/// Opens an index with a copy of it in this process: own writes are in the copy at once and travel in the background,
/// writes of others arrive as they happen.
///
/// Thread-safe.
///
/// # Safety
/// The strings of `server` end with 0 or may be null; `index` can be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn wayfold_index_shared(
    server: *const WayfoldServer,
    index: *mut *mut WayfoldIndex,
) -> Code {
    call(|| {
        // SAFETY: the caller's promise.
        let settings = unsafe { Settings::read(server) }?;
        // SAFETY: the caller's promise.
        unsafe { give(open!(Index::shared, settings), index) }
    })
}

/// Opens an index without a copy: each call is one of the server's, and waits for it.
///
/// Thread-safe.
///
/// # Safety
/// The strings of `server` end with 0 or may be null; `index` can be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn wayfold_index_remote(
    server: *const WayfoldServer,
    index: *mut *mut WayfoldIndex,
) -> Code {
    call(|| {
        // SAFETY: the caller's promise.
        let settings = unsafe { Settings::read(server) }?;
        // SAFETY: the caller's promise.
        unsafe { give(open!(Index::remote, settings), index) }
    })
}

/// Waits until the server has acknowledged every write before this call. Returns at once for the other forms.
///
/// Thread-safe.
///
/// # Safety
/// `index` is a handle.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn wayfold_index_flush(index: *const WayfoldIndex) -> Code {
    call(|| {
        // SAFETY: the caller's promise.
        unsafe { index_of(index) }?.flush()?;
        Ok(())
    })
}

/// Writes the number of writes that the server has not acknowledged; 0 for the other forms.
///
/// Thread-safe.
///
/// # Safety
/// `index` is a handle; `pending` can be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn wayfold_index_pending(
    index: *const WayfoldIndex,
    pending: *mut u64,
) -> Code {
    call(|| {
        // SAFETY: the caller's promise.
        unsafe { put(index_of(index)?.pending(), pending, "pending") }
    })
}

/// Takes no more writes of a shared index and waits for the pending ones, at most for `timeout_ms`. Writes the number of
/// those that the server has not acknowledged.
///
/// Thread-safe.
///
/// # Safety
/// `index` is a handle; `unsent` can be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn wayfold_index_close(
    index: *const WayfoldIndex,
    timeout_ms: u64,
    unsent: *mut usize,
) -> Code {
    call(|| {
        if unsent.is_null() {
            return Err(null("unsent"));
        }
        // SAFETY: the caller's promise.
        let writes = unsafe { index_of(index) }?.close(Duration::from_millis(timeout_ms));
        // SAFETY: the caller's promise.
        unsafe { put(writes.len(), unsent, "unsent") }
    })
}

/// A server's settings with checked strings.
struct Settings<'a> {
    uri: &'a str,
    name: &'a str,
    space: Option<client::Space>,
    credentials: Credentials,
    timeout: Option<Duration>,
}

impl<'a> Settings<'a> {
    /// # Safety
    /// `server` is null, or its strings end with 0 or are null.
    unsafe fn read(server: *const WayfoldServer) -> Result<Settings<'a>, Failure> {
        // SAFETY: the caller's promise.
        let server = unsafe { server.as_ref() };
        let server = server.ok_or_else(|| Failure::argument("server", "a null pointer"))?;
        let mut settings = Settings {
            // SAFETY: the caller's promise.
            uri: unsafe { text(server.uri, "uri") }?,
            // SAFETY: the caller's promise.
            name: unsafe { text(server.name, "name") }?,
            space: None,
            credentials: Credentials::default(),
            timeout: (server.timeout_ms > 0).then(|| Duration::from_millis(server.timeout_ms)),
        };
        if !server.space.is_null() {
            // SAFETY: the caller's promise.
            settings.space = Some(parse_space(unsafe { text(server.space, "space") }?)?);
        }
        if !server.token.is_null() {
            // SAFETY: the caller's promise.
            settings.credentials = settings
                .credentials
                .token(unsafe { text(server.token, "token") }?);
        }
        Ok(settings)
    }
}
