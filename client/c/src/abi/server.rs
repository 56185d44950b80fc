//! The functions of the ABI for indices on a server.

use std::{ffi::c_char, ptr, time::Duration};

use client::{Credentials, Index, PayloadEncoding};

use super::{
    connection::unforked_index_of,
    index::WayfoldIndex,
    pointers::{give, index_of, null, parse_space, put, text},
};
use crate::{
    code::Code,
    failure::{Failure, call},
};

/// An index on a server. Begin with `wayfold_server_default()`, and set `uri` and `name`.
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
    /// The certificates of the authorities that certify the server, in PEM, or null. An address with https needs them.
    pub ca_certificate: *const c_char,
    /// The certificate of this client and those between it and its authority, in PEM, or null.
    pub client_certificate: *const c_char,
    /// The private key of `client_certificate`, in PEM; null without one.
    pub client_key: *const c_char,
    /// The longest time of a call in milliseconds; 0 for the client's own, 30 s.
    pub timeout_ms: u64,
    /// How the payloads of an index that is created here hold edges, for programs that read them. 0: nothing is declared.
    /// 1: 8 bytes an edge, the id at its other end, little-endian. 2: 16 bytes an edge, the id and the cost as an IEEE 754
    /// double, both little-endian. An index that declares another encoding is refused; one that declares nothing is opened
    /// (`wayfold_index_payload_encoding` tells). Ignored if `space` is null.
    pub payload_encoding: u32,
    /// The most bytes of writes that a shared index has pending: a write that exceeds them waits. 0 for the client's own,
    /// 16 MiB. The remote form has no pending writes.
    pub max_pending_bytes: u64,
    /// 1: searches, gets and scans of a remote index see all that any server of a cluster acknowledged before. 0: they see
    /// the caller's own writes, and may lag behind those of others. The shared form ignores it.
    // A byte that is no bool would be undefined behaviour in Rust.
    pub reads_latest: u8,
}

/// A server without an address and a name, and the client's own choices in all other fields.
///
/// Thread-safe.
#[unsafe(no_mangle)]
pub extern "C" fn wayfold_server_default() -> WayfoldServer {
    WayfoldServer {
        uri: ptr::null(),
        name: ptr::null(),
        space: ptr::null(),
        token: ptr::null(),
        ca_certificate: ptr::null(),
        client_certificate: ptr::null(),
        client_key: ptr::null(),
        timeout_ms: 0,
        payload_encoding: 0,
        max_pending_bytes: 0,
        reads_latest: 0,
    }
}

/// The builder of an index, whose methods both forms have.
macro_rules! opening {
    ($form:path, $settings:ident) => {{
        let mut open = $form($settings.uri, $settings.name).credentials($settings.credentials);
        if let Some(space) = &$settings.space {
            open = open
                .create(space)
                .payload_encoding($settings.payload_encoding);
        }
        if let Some(timeout) = $settings.timeout {
            open = open.timeout(timeout);
        }
        open
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
        let mut open = opening!(Index::shared, settings);
        if let Some(bytes) = settings.max_pending_bytes {
            open = open.max_pending_bytes(bytes);
        }
        // SAFETY: the caller's promise.
        unsafe { give(open.open()?, index) }
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
        let mut open = opening!(Index::remote, settings);
        if settings.reads_latest {
            open = open.latest();
        }
        // SAFETY: the caller's promise.
        unsafe { give(open.open()?, index) }
    })
}

/// Writes how the payloads of the index hold edges, as `payload_encoding` of the `wayfold_server` that created it: another
/// program may have created it, and a payload that means something else may look like edges. 0 if the index declares
/// nothing, and in memory.
///
/// Thread-safe.
///
/// # Safety
/// `index` is a handle; `payload_encoding` can be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn wayfold_index_payload_encoding(
    index: *const WayfoldIndex,
    payload_encoding: *mut u32,
) -> Code {
    call(|| {
        // SAFETY: the caller's promise.
        let declared = match unsafe { unforked_index_of(index) }?.payload_encoding() {
            PayloadEncoding::Unspecified => 0,
            PayloadEncoding::Edges => 1,
            PayloadEncoding::WeightedEdges => 2,
        };
        // SAFETY: the caller's promise.
        unsafe { put(declared, payload_encoding, "payload_encoding") }
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

/// Acts like `wayfold_index_flush`, but waits at most for `timeout_ms` instead of the index's own timeout.
///
/// Thread-safe.
///
/// # Safety
/// `index` is a handle.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn wayfold_index_flush_within(
    index: *const WayfoldIndex,
    timeout_ms: u64,
) -> Code {
    call(|| {
        // SAFETY: the caller's promise.
        unsafe { index_of(index) }?.flush_within(Duration::from_millis(timeout_ms))?;
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
        unsafe { put(unforked_index_of(index)?.pending(), pending, "pending") }
    })
}

/// A server's settings with checked strings.
struct Settings<'a> {
    uri: &'a str,
    name: &'a str,
    space: Option<client::Space>,
    credentials: Credentials,
    timeout: Option<Duration>,
    payload_encoding: PayloadEncoding,
    max_pending_bytes: Option<usize>,
    reads_latest: bool,
}

impl<'a> Settings<'a> {
    /// # Safety
    /// `server` is null, or its strings end with 0 or are null.
    unsafe fn read(server: *const WayfoldServer) -> Result<Settings<'a>, Failure> {
        // SAFETY: the caller's promise.
        let server = unsafe { server.as_ref() };
        let server = server.ok_or_else(|| null("server"))?;
        let mut settings = Settings {
            // SAFETY: the caller's promise.
            uri: unsafe { text(server.uri, "uri") }?,
            // SAFETY: the caller's promise.
            name: unsafe { text(server.name, "name") }?,
            space: None,
            credentials: Credentials::default(),
            timeout: (server.timeout_ms > 0).then(|| Duration::from_millis(server.timeout_ms)),
            payload_encoding: match server.payload_encoding {
                0 => PayloadEncoding::Unspecified,
                1 => PayloadEncoding::Edges,
                2 => PayloadEncoding::WeightedEdges,
                _ => return Err(Failure::argument("payload_encoding", "none of 0, 1 and 2")),
            },
            max_pending_bytes: (server.max_pending_bytes > 0)
                .then(|| usize::try_from(server.max_pending_bytes).unwrap_or(usize::MAX)),
            reads_latest: match server.reads_latest {
                0 => false,
                1 => true,
                _ => return Err(Failure::argument("reads_latest", "neither 0 nor 1")),
            },
        };
        if !server.space.is_null() {
            // SAFETY: the caller's promise.
            settings.space = Some(parse_space(unsafe { text(server.space, "space") }?)?);
        }
        // SAFETY: the caller's promise.
        settings.credentials = unsafe { credentials(server) }?;
        Ok(settings)
    }
}

/// # Safety
/// The strings of `server` end with 0 or are null.
unsafe fn credentials(server: &WayfoldServer) -> Result<Credentials, Failure> {
    let mut credentials = Credentials::new();
    if !server.token.is_null() {
        // SAFETY: the caller's promise.
        credentials = credentials.token(unsafe { text(server.token, "token") }?);
    }
    if !server.ca_certificate.is_null() {
        // SAFETY: the caller's promise.
        let ca = unsafe { text(server.ca_certificate, "ca_certificate") }?;
        credentials = credentials.ca_certificate(ca);
    }
    if !server.client_certificate.is_null() || !server.client_key.is_null() {
        // SAFETY: the caller's promise. A certificate without its key is refused, and a key without its certificate.
        let (certificate, key) = unsafe {
            (
                text(server.client_certificate, "client_certificate")?,
                text(server.client_key, "client_key")?,
            )
        };
        credentials = credentials.client_certificate(certificate, key);
    }
    Ok(credentials)
}
