//! The kind and the reason of each error, for programs to match on.

use super::{Error, Unavailability};
use crate::identity::{Denial, IdentificationError};

/// The kinds of failure a caller can tell apart: the eleven codes of the contract, named as gRPC names them.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Code {
    /// A field of the request is wrong, independent of the index.
    InvalidArgument,
    /// The index or points do not exist.
    NotFound,
    /// Another index or other points exist under the name or ids.
    AlreadyExists,
    /// The index is not in the state that the request requires.
    FailedPrecondition,
    /// The call exceeds a limit of the server, or its memory or disk is full.
    ResourceExhausted,
    /// The server is starting or stopping, its disk cannot be written, or it has no memory for the index: try again.
    Unavailable,
    /// The call ran out of time.
    DeadlineExceeded,
    /// The caller is not identified.
    Unauthenticated,
    /// The caller may not do this.
    PermissionDenied,
    /// Stored data is damaged.
    DataLoss,
    /// A bug.
    Internal,
}

impl Code {
    /// All of them, with their numbers in google.rpc.Code and their names as gRPC spells them.
    const ALL: [(Code, i32, &str); 11] = [
        (Code::InvalidArgument, 3, "INVALID_ARGUMENT"),
        (Code::DeadlineExceeded, 4, "DEADLINE_EXCEEDED"),
        (Code::NotFound, 5, "NOT_FOUND"),
        (Code::AlreadyExists, 6, "ALREADY_EXISTS"),
        (Code::PermissionDenied, 7, "PERMISSION_DENIED"),
        (Code::ResourceExhausted, 8, "RESOURCE_EXHAUSTED"),
        (Code::FailedPrecondition, 9, "FAILED_PRECONDITION"),
        (Code::Internal, 13, "INTERNAL"),
        (Code::Unavailable, 14, "UNAVAILABLE"),
        (Code::DataLoss, 15, "DATA_LOSS"),
        (Code::Unauthenticated, 16, "UNAUTHENTICATED"),
    ];

    /// Its number.
    pub fn number(self) -> i32 {
        let found = Self::ALL.iter().find(|known| known.0 == self);
        found.map_or(0, |known| known.1)
    }

    /// The code of this number; `None` for one that no server of Wayfold gives.
    pub fn of_number(number: i32) -> Option<Self> {
        let found = Self::ALL.iter().find(|known| known.1 == number);
        found.map(|known| known.0)
    }

    /// Its name as gRPC spells it.
    pub fn name(self) -> &'static str {
        let found = Self::ALL.iter().find(|known| known.0 == self);
        found.map_or("", |known| known.2)
    }
}

impl Error {
    /// The kind of failure.
    pub fn code(&self) -> Code {
        match self {
            Error::InvalidArgument { .. }
            | Error::OperationMismatch { .. }
            | Error::BatchMismatch { .. } => Code::InvalidArgument,
            Error::IndexNotFound { .. } | Error::PointsNotFound { .. } => Code::NotFound,
            Error::IndexExists { .. }
            | Error::NameTaken { .. }
            | Error::PointsExist { .. }
            | Error::IdsReserved { .. } => Code::AlreadyExists,
            Error::UidMismatch { .. }
            | Error::RevisionConflict { .. }
            | Error::ScanEnded { .. }
            | Error::SessionRefused { .. } => Code::FailedPrecondition,
            Error::LimitExceeded { .. }
            | Error::TooManyBytes { .. }
            | Error::Full { .. }
            | Error::QuotaExceeded { .. }
            | Error::IdsExhausted { .. }
            | Error::ScanTooLong { .. }
            | Error::HeldTooLong { .. } => Code::ResourceExhausted,
            Error::Unavailable { .. }
            | Error::StorageFailed { .. }
            | Error::NotLoaded { .. }
            | Error::UidUnknown { .. } => Code::Unavailable,
            Error::Denied { why } => match why {
                Denial::Unknown(IdentificationError::TooManyCalls(_)) => Code::ResourceExhausted,
                Denial::Unknown(_) => Code::Unauthenticated,
                Denial::Role { .. } | Denial::Index { .. } | Denial::Metrics { .. } => {
                    Code::PermissionDenied
                }
            },
            Error::DeadlineExceeded { .. } => Code::DeadlineExceeded,
            Error::Forwarded { status } => Code::of_number(status.code).unwrap_or(Code::Internal),
            Error::DataLoss { .. } => Code::DataLoss,
            Error::Internal { .. } => Code::Internal,
        }
    }

    /// The reason in UPPER_SNAKE_CASE; of several violations, the first one's.
    pub fn reason(&self) -> &'static str {
        match self {
            Error::InvalidArgument { violations } => violations
                .first()
                .map_or("INVALID_ARGUMENT", |violation| violation.reason),
            Error::IndexNotFound { .. } => "INDEX_NOT_FOUND",
            Error::PointsNotFound { .. } => "POINTS_NOT_FOUND",
            Error::IndexExists { .. } | Error::NameTaken { .. } => "INDEX_EXISTS",
            Error::PointsExist { .. } => "POINTS_EXIST",
            Error::IdsReserved { .. } => "IDS_RESERVED",
            Error::SessionRefused { newest: None, .. } => "SESSION_ENDED",
            Error::SessionRefused { .. } => "BATCH_OUT_OF_ORDER",
            Error::BatchMismatch { .. } => "BATCH_MISMATCH",
            Error::UidMismatch { .. } => "UID_MISMATCH",
            Error::UidUnknown { .. } => "UID_UNKNOWN",
            Error::RevisionConflict { .. } => "REVISION_CONFLICT",
            Error::LimitExceeded { .. } => "LIMIT_EXCEEDED",
            Error::TooManyBytes { .. } => "TOO_MANY_BYTES",
            Error::Full { full } => full.resource.reason(),
            Error::QuotaExceeded { .. } => "QUOTA_EXCEEDED",
            Error::NotLoaded { .. } => "NOT_LOADED",
            Error::IdsExhausted { .. } => "IDS_EXHAUSTED",
            Error::ScanTooLong { .. } => "SCAN_TOO_LONG",
            Error::ScanEnded { .. } => "SCAN_ENDED",
            Error::HeldTooLong { .. } => "HELD_TOO_LONG",
            Error::Unavailable { why } => match why {
                Unavailability::Starting => "STARTING",
                Unavailability::Stopping => "STOPPING",
            },
            Error::Denied { why } => match why {
                Denial::Unknown(IdentificationError::NoCredential) => "NO_CREDENTIAL",
                Denial::Unknown(IdentificationError::WrongCredential) => "WRONG_CREDENTIAL",
                Denial::Unknown(IdentificationError::Expired) => "IDENTITY_EXPIRED",
                Denial::Unknown(IdentificationError::Revoked) => "IDENTITY_REVOKED",
                Denial::Unknown(IdentificationError::TooManyCalls(_)) => "TOO_MANY_CALLS",
                Denial::Role { .. } => "ROLE_TOO_LOW",
                Denial::Index { .. } => "INDEX_NOT_ALLOWED",
                Denial::Metrics { .. } => "METRICS_NOT_ALLOWED",
            },
            Error::DeadlineExceeded { .. } => "DEADLINE_EXCEEDED",
            Error::Forwarded { .. } => "FORWARDED",
            Error::OperationMismatch { .. } => "OPERATION_MISMATCH",
            Error::StorageFailed { .. } => "STORAGE_FAILED",
            Error::DataLoss { .. } => "DATA_LOSS",
            Error::Internal { .. } => "INTERNAL",
        }
    }
}
