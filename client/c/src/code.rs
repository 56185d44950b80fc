//! The codes that functions return.

/// The result of a call: gRPC's codes.
#[repr(C)]
#[cfg_attr(
    not(feature = "net"),
    expect(dead_code, reason = "only calls of a server have these codes")
)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Code {
    /// The call took effect.
    Ok = 0,
    /// The call was cancelled.
    Cancelled = 1,
    /// An error without a better code.
    Unknown = 2,
    /// A state, a space or another argument is invalid.
    InvalidArgument = 3,
    /// The call or the search did not end in time.
    DeadlineExceeded = 4,
    /// The server has no index of this name.
    NotFound = 5,
    /// The id is taken, or the index exists with another space or encoding of payloads.
    AlreadyExists = 6,
    /// The caller lacks the right.
    PermissionDenied = 7,
    /// A limit of the server, or it is busy or full: the reason tells.
    ResourceExhausted = 8,
    /// The index is closed, was opened before a fork, or was made again; or its writer session has ended.
    FailedPrecondition = 9,
    /// No server of this version sends it.
    Aborted = 10,
    /// A number is out of range.
    OutOfRange = 11,
    /// The server does not know the call.
    Unimplemented = 12,
    /// A panic in the library, or a broken protocol.
    Internal = 13,
    /// The server cannot be reached, or cannot answer now.
    Unavailable = 14,
    /// The server has lost data.
    DataLoss = 15,
    /// The server does not know the caller.
    Unauthenticated = 16,
}
