//! Errors of the registry.

use thiserror::Error;
use wayfold_index::Space;

use crate::log::{LogError, Uid};

/// The error of a call of the registry.
#[derive(Clone, Debug, PartialEq, Error)]
pub enum RegistryError {
    /// The index does not exist, or no longer.
    #[error("the index was deleted")]
    Deleted,
    /// An index of this name exists and has another space.
    #[error("an index of this name exists with the space {space}")]
    Exists {
        /// Its space.
        space: Space,
    },
    /// An index of this name exists, so none can be restored under it.
    #[error("an index of this name exists")]
    Taken,
    /// The index has another uid.
    #[error("the index has the uid {found}")]
    OtherUid {
        /// Its uid.
        found: Uid,
    },
    /// The registry has reached its limit of indices.
    #[error("the server holds {limit} indices, the limit")]
    Full {
        /// The limit.
        limit: usize,
    },
    /// A task of the index panicked or was aborted: a bug.
    #[error("a task of the index did not finish")]
    Stopped,
    /// The log failed.
    #[error(transparent)]
    Log(LogError),
}

impl From<LogError> for RegistryError {
    fn from(error: LogError) -> Self {
        match error {
            LogError::UnknownIndex { .. } => Self::Deleted,
            error @ (LogError::UidTaken { .. }
            | LogError::Fenced { .. }
            | LogError::Unconfirmed { .. }
            | LogError::Trimmed { .. }
            | LogError::Damaged { .. }
            | LogError::DamagedPoint { .. }
            | LogError::Lost { .. }
            | LogError::Incomplete { .. }
            | LogError::Unreadable { .. }
            | LogError::Unopened { .. }
            | LogError::Shut { .. }
            | LogError::Storage { .. }
            | LogError::StorageStopped
            | LogError::DamagedStore { .. }
            | LogError::Closed) => Self::Log(error),
        }
    }
}
