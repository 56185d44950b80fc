//! Opens the store of a closed log by itself, to rewrite its files.

use std::path::Path;

use fjall::{Database, Keyspace, KeyspaceCreateOptions};

/// The store of a closed log.
pub(crate) fn open_store(directory: &Path) -> (Database, Keyspace) {
    let database = Database::builder(directory.join("store")).open().unwrap();
    let keyspace = database.keyspace("wayfold", KeyspaceCreateOptions::default);
    let keyspace = keyspace.unwrap();
    (database, keyspace)
}

/// Moves the content of a closed log from the journal to tables.
pub(crate) fn move_to_tables(directory: &Path) {
    let (_database, keyspace) = open_store(directory);
    keyspace.rotate_memtable_and_wait().unwrap();
}
