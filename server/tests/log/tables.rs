//! The store of a closed log: written to tables, and damaged in them.

use std::{
    fs::{self, File},
    io::{Seek, SeekFrom, Write},
    ops::RangeInclusive,
    path::{Path, PathBuf},
    sync::Arc,
};

use bytes::Bytes;
use fjall::{Database, Keyspace, KeyspaceCreateOptions};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use wayfold_index::PointRef;
use wayfold_server::log::{
    Catalogue, Durability, Effects, Entry, FjallLog, Journal, LogError, Outcome, PointStore,
    Record, Uid,
};

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

/// The incompressible payload of a point.
pub(crate) fn payload(id: u64, bytes: usize) -> Bytes {
    let mut payload = vec![0; bytes];
    ChaCha8Rng::seed_from_u64(id).fill_bytes(&mut payload);
    payload.into()
}

pub(crate) fn created(log: &FjallLog, name: &str) -> Entry {
    let entry = Entry {
        uid: Uid::unique(),
        name: name.into(),
        space: "R1".parse().unwrap(),
        payload_encoding: Default::default(),
    };
    log.create(entry.clone()).unwrap();
    entry
}

/// Stores the point with the id of the next revision.
pub(crate) fn grow(log: &FjallLog, uid: Uid, payload: Bytes) -> Result<u64, LogError> {
    let position = log.view(uid)?.position();
    let revision = position.revision + 1;
    let mut effects = Effects::new(1);
    let point = PointRef {
        id: revision,
        tag: 0,
        revision,
        row: &[0.5],
    };
    effects.store(point, Outcome::Inserted, payload);
    log.submit(uid, Arc::new(Record::after(position, effects)))?;
    Ok(revision)
}

/// Creates an index that is wholly in tables, one for each range of its revisions.
pub(crate) fn in_tables(
    directory: &Path,
    name: &str,
    ranges: &[RangeInclusive<u64>],
    payload_bytes: usize,
) -> Entry {
    let open = || FjallLog::open(directory, Durability::Fsync).unwrap();
    let entry = created(&open(), name);
    for revisions in ranges {
        let log = open();
        for id in revisions.clone() {
            grow(&log, entry.uid, payload(id, payload_bytes)).unwrap();
        }
        drop(log);
        move_to_tables(directory);
    }
    entry
}

pub(crate) fn table_files(directory: &Path) -> Vec<PathBuf> {
    let tables = fs::read_dir(directory.join("store/keyspaces/1/tables")).unwrap();
    tables.map(|table| table.unwrap().path()).collect()
}

/// The tables that hold these bytes, and where; the point comes before the record that stored it.
pub(crate) fn places(directory: &Path, bytes: &[u8]) -> Vec<(PathBuf, usize)> {
    let mut places = Vec::new();
    for table in table_files(directory) {
        let content = fs::read(&table).unwrap();
        let windows = content.windows(bytes.len()).enumerate();
        let found = windows.filter(|(_, window)| *window == bytes);
        places.extend(found.map(|(at, _)| (table.clone(), at)));
    }
    places
}

/// Flips a bit in place, so that a store that has the file open meets the damage too.
pub(crate) fn flip(file: &Path, at: usize) {
    let byte = fs::read(file).unwrap()[at];
    let mut file = File::options().write(true).open(file).unwrap();
    file.seek(SeekFrom::Start(at as u64)).unwrap();
    file.write_all(&[byte ^ 1]).unwrap();
}
