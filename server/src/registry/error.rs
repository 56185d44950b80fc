//! Why the registry refused.

use thiserror::Error;
use wayfold_index::Space;

use crate::log::{LogError, Uid};

/// Why the registry refused, or failed.
#[derive(Clone, Debug, PartialEq, Error)]
pub enum RegistryError {
    /// The index is not there, or not any more.
    #[error("the index was deleted")]
    Deleted,
    /// An index of this name exists with another space.
    #[error("an index of this name exists with the space {space}")]
    Exists {
        /// Its space.
        space: Space,
    },
    /// An index of this name exists, and a restored one cannot be it.
    #[error("an index of this name exists")]
    Taken,
    /// The index has another uid.
    #[error("the index has the uid {found}")]
    OtherUid {
        /// Its uid.
        found: Uid,
    },
    /// There are as many indices as there may be.
    #[error("there are {limit} indices already")]
    Full {
        /// How many there may be.
        limit: usize,
    },
    /// The index stopped in the middle of a mutation: a bug.
    #[error("a mutation of the index did not come to its end")]
    Stopped,
    /// The log refused, or failed.
    #[error(transparent)]
    Log(LogError),
}

impl From<LogError> for RegistryError {
    fn from(error: LogError) -> Self {
        match error {
            LogError::UnknownIndex { .. } => Self::Deleted,
            error @ (LogError::UidTaken { .. }
            | LogError::Fenced { .. }
            | LogError::Trimmed { .. }
            | LogError::Damaged { .. }
            | LogError::DamagedPoint { .. }
            | LogError::Lost { .. }
            | LogError::Incomplete { .. }
            | LogError::Unreadable { .. }
            | LogError::Unopened { .. }
            | LogError::Shut { .. }
            | LogError::Storage { .. }
            | LogError::Closed) => Self::Log(error),
        }
    }
}
