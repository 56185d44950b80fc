//! The stores under test.

use wayfold_server::log::{Durability, FjallLog, MemoryLog};

use crate::{Engine, copied::copied, fault::FaultLog};

/// A log under test, which is closed and opened again, cut off and made to fail where it can be.
pub(crate) enum Kept {
    Memory(MemoryLog),
    Disk {
        log: Option<Box<FjallLog>>,
        directory: tempfile::TempDir,
    },
    Faulty(FaultLog),
}

impl Kept {
    pub(crate) fn in_memory() -> Self {
        Self::Memory(MemoryLog::new())
    }

    pub(crate) fn on_disk() -> Self {
        Self::in_directory(tempfile::tempdir().unwrap())
    }

    fn in_directory(directory: tempfile::TempDir) -> Self {
        let log = FjallLog::open(directory.path(), Durability::Fsync).unwrap();
        Self::Disk {
            log: Some(Box::new(log)),
            directory,
        }
    }

    pub(crate) fn faulty(seed: u64) -> Self {
        Self::Faulty(FaultLog::new(seed))
    }

    /// An empty log of the same kind, which does not fail.
    pub(crate) fn another(&self) -> Self {
        match self {
            Kept::Memory(_) => Self::in_memory(),
            Kept::Disk { .. } => Self::on_disk(),
            Kept::Faulty(_) => Self::faulty(0),
        }
    }

    pub(crate) fn log(&self) -> &dyn Engine {
        match self {
            Kept::Memory(log) => log,
            Kept::Disk { log, .. } => &**log.as_ref().unwrap(),
            Kept::Faulty(log) => log,
        }
    }

    /// Closes it in order and opens it again. No view of it may be held.
    pub(crate) fn reopen(&mut self) {
        match self {
            Kept::Memory(_) => {}
            Kept::Disk { log, directory } => {
                *log = None;
                let opened = FjallLog::open(directory.path(), Durability::Fsync).unwrap();
                *log = Some(Box::new(opened));
            }
            Kept::Faulty(log) => log.close_and_open(),
        }
    }

    /// Ends the log without closing it. Unsynced writes may be lost. A log on disk loses what a killed process loses.
    pub(crate) fn cut(&mut self) {
        match self {
            Kept::Memory(_) => {}
            Kept::Disk { directory, .. } => *self = Self::in_directory(copied(directory.path())),
            Kept::Faulty(log) => log.cut(),
        }
    }

    /// Lets the writing call after this many others fail; false if it cannot.
    pub(crate) fn fail_after(&self, calls: u64) -> bool {
        match self {
            Kept::Memory(_) | Kept::Disk { .. } => false,
            Kept::Faulty(log) => {
                log.fail_after(calls);
                true
            }
        }
    }
}
