//! The store of a directory.

use std::{fmt::Display, path::Path};

use fjall::{Database, Keyspace, KeyspaceCreateOptions};

use super::Durability;
use crate::log::LogError;

/// Most bytes of journal before the store moves points out of it: what a restart reads again at most.
const JOURNAL_BYTES: u64 = 128 * 1024 * 1024;

/// The open store.
pub(super) struct Store {
    pub(super) database: Database,
    /// All there is, as [`layout`](super::layout) describes it.
    pub(super) keyspace: Keyspace,
}

impl Store {
    /// Opens the store in a directory, or makes it there.
    pub(super) fn open(directory: &Path, durability: Durability) -> fjall::Result<Self> {
        let database = Database::builder(directory)
            .max_journaling_size(JOURNAL_BYTES)
            // The syncer hands batches on to the operating system, or nobody does.
            .manual_journal_persist(durability != Durability::Os)
            .open()?;
        let keyspace = database.keyspace("wayfold", KeyspaceCreateOptions::default)?;
        Ok(Self { database, keyspace })
    }
}

/// A failure of the store.
pub(super) fn storage(error: impl Display) -> LogError {
    LogError::Storage {
        what: error.to_string(),
    }
}
