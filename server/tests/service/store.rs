//! The store that keeps the indices from one start of the server to the next.

use std::sync::Arc;

use wayfold_server::log::{Durability, FjallLog, Log, MemoryLog};

use crate::{copied::copied, fault::FaultLog};

pub(crate) enum Store {
    Memory(Arc<MemoryLog>),
    /// The store on disk outlives the servers over it.
    Disk(tempfile::TempDir),
    /// A log in memory that can lose its power.
    Faulty(FaultLog),
}

/// The end of a server.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum End {
    Orderly,
    Crash,
}

impl Store {
    pub(crate) fn in_memory() -> Self {
        Self::Memory(Arc::new(MemoryLog::new()))
    }

    pub(crate) fn on_disk() -> Self {
        Self::Disk(tempfile::tempdir().unwrap())
    }

    pub(crate) fn open(&self) -> Log {
        match self {
            Self::Memory(log) => Arc::clone(log).into(),
            Self::Disk(directory) => {
                Arc::new(FjallLog::open(directory.path(), Durability::Fsync).unwrap()).into()
            }
            Self::Faulty(log) => Arc::new(log.clone()).into(),
        }
    }

    /// The store that is left if the server ends in its present state. The server still runs.
    pub(crate) fn left(&self, end: End) -> Option<Self> {
        match (self, end) {
            (Self::Disk(directory), End::Crash) => Some(Self::Disk(copied(directory.path()))),
            _ => None,
        }
    }

    /// Closes the store; call it once the server has ended.
    pub(crate) fn close(&self, end: End) {
        match (self, end) {
            (Self::Faulty(log), End::Crash) => log.cut(),
            (Self::Faulty(log), End::Orderly) => log.close_and_open(),
            (Self::Memory(_) | Self::Disk(_), _) => {}
        }
    }
}
