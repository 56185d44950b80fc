//! Errors of the registry.

use thiserror::Error;

use crate::{
    log::{LogError, Uid},
    watermark::WatermarkExceeded,
};

/// The error of a call of the registry.
#[derive(Clone, Debug, PartialEq, Error)]
pub enum RegistryError {
    /// The index does not exist, or no longer.
    #[error("the index was deleted")]
    Deleted,
    /// An index of this name exists and differs.
    #[error("an index of this name exists with the {what} {existing}")]
    Exists {
        /// The property that differs.
        what: &'static str,
        /// The value of the existing index.
        existing: String,
        /// The requested value.
        requested: String,
    },
    /// An index of this name exists, so none can be restored under it.
    #[error("an index of this name exists")]
    Taken,
    /// The index goes on by itself, so no copy takes its place.
    #[error("the index follows its journal, so no copy takes its place")]
    Follows,
    /// The index has another uid.
    #[error("the index has the uid {found}")]
    OtherUid {
        /// Its uid.
        found: Uid,
    },
    /// Another server may have given the requested uid to the index.
    #[error("nothing is known of the uid yet")]
    UnknownUid,
    /// There are as many indices as a limit allows.
    #[error("there are {max} indices, as many as {setting} allows")]
    TooManyIndexes {
        /// The name of the limit.
        setting: &'static str,
        /// The limit.
        max: usize,
    },
    /// The server takes in nothing that grows it.
    #[error(transparent)]
    NoRoom(#[from] WatermarkExceeded),
    /// The index is not in memory: at the start it would have taken too much.
    #[error(
        "its {points} points take about {needed} bytes of memory, too many at the start: {full}"
    )]
    NotLoaded {
        /// The number of its points.
        points: usize,
        /// About the bytes that they take.
        needed: u64,
        /// The memory when it was loaded.
        full: WatermarkExceeded,
    },
    /// A task of the index panicked or was aborted: a bug.
    #[error("a task of the index did not finish")]
    Stopped,
    /// The log failed.
    #[error(transparent)]
    Log(LogError),
}

impl RegistryError {
    /// The error for a caller, who finds the points at other servers too if `is_shared`.
    pub(super) fn of_copy(self, is_shared: bool) -> Self {
        match self {
            Self::Log(error) if is_shared => Self::Log(error.of_copy()),
            Self::Stopped if is_shared => Self::Log(LogError::CopyUnreadable {
                what: Self::Stopped.to_string(),
            }),
            other => other,
        }
    }
}

impl From<LogError> for RegistryError {
    fn from(error: LogError) -> Self {
        match error {
            LogError::UnknownIndex { .. } => Self::Deleted,
            error => Self::Log(error),
        }
    }
}
