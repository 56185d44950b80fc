//! The stores under test.

use wayfold_server::log::{Durability, FjallLog, MemoryLog};

use crate::{Engine, copied::copied, fault::FaultLog, remote::RemoteLog};

/// A log under test: a test closes and reopens it, ends it without closing, and makes it fail.
pub(crate) enum TestLog {
    Memory(MemoryLog),
    Disk {
        log: Option<Box<FjallLog>>,
        directory: tempfile::TempDir,
    },
    Faulty(FaultLog),
    Remote(Box<RemoteLog>),
}

impl TestLog {
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

    /// A log whose journal is on another machine and loses every fifth message.
    pub(crate) fn remote(seed: u64) -> Self {
        Self::Remote(Box::new(RemoteLog::new(seed, 0.2)))
    }

    /// A log whose journal is in NATS.
    pub(crate) fn in_nats() -> Self {
        Self::Remote(Box::new(RemoteLog::in_nats()))
    }

    pub(crate) fn of_every_kind() -> [Self; 4] {
        [
            Self::in_memory(),
            Self::on_disk(),
            Self::faulty(1),
            Self::remote(1),
        ]
    }

    /// An empty log of the same kind that never fails.
    pub(crate) fn another(&self) -> Self {
        match self {
            TestLog::Memory(_) => Self::in_memory(),
            TestLog::Disk { .. } => Self::on_disk(),
            TestLog::Faulty(_) => Self::faulty(0),
            TestLog::Remote(_) => Self::remote(0),
        }
    }

    pub(crate) fn log(&self) -> &dyn Engine {
        match self {
            TestLog::Memory(log) => log,
            TestLog::Disk { log, .. } => &**log.as_ref().unwrap(),
            TestLog::Faulty(log) => log,
            TestLog::Remote(log) => &**log,
        }
    }

    /// Closes it in order and opens it again. No view of it may be held.
    pub(crate) fn reopen(&mut self) {
        match self {
            TestLog::Memory(_) => {}
            TestLog::Disk { log, directory } => {
                *log = None;
                let opened = FjallLog::open(directory.path(), Durability::Fsync).unwrap();
                *log = Some(Box::new(opened));
            }
            TestLog::Faulty(log) => log.close_and_open(),
            TestLog::Remote(log) => log.reconnect(),
        }
    }

    /// Ends the log without closing it. Unsynced writes may be lost. A log on disk loses what a killed process loses.
    pub(crate) fn cut(&mut self) {
        match self {
            TestLog::Memory(_) => {}
            TestLog::Disk { directory, .. } => *self = Self::in_directory(copied(directory.path())),
            TestLog::Faulty(log) => log.cut(),
            TestLog::Remote(log) => log.reconnect(),
        }
    }

    /// Makes the writing call after this many others fail; false if this store cannot fail.
    pub(crate) fn fail_after(&self, calls: u64) -> bool {
        match self {
            TestLog::Memory(_) | TestLog::Disk { .. } | TestLog::Remote(_) => false,
            TestLog::Faulty(log) => {
                log.fail_after(calls);
                true
            }
        }
    }
}
