//! The writes of one insert of one state, read from our log: the keys and values of its batch.

use std::{collections::BTreeMap, path::Path};

use fjall::{Database, KeyspaceCreateOptions, Readable};
use wayfold_server::log::Durability;

use crate::{
    INDEX, WIDTH,
    base_directory::BaseDirectory,
    service::{LocalService, insertion},
};

/// The directory in which our log keeps its store, and the keyspace that holds all of it.
pub(crate) const STORE: &str = "store";
pub(crate) const KEYSPACE: &str = "wayfold";
/// The kept bytes of records while the shape is read. It is small, so that each insert also removes a record.
const WINDOW_BYTES: usize = 4096;
const INSERTS: usize = 40;

/// The batch of one insert.
#[derive(Clone, Debug, Default)]
pub(crate) struct Shape {
    /// Keys and values that are new with each insert; the keys end with a number that counts.
    pub(crate) added: Vec<(Vec<u8>, Vec<u8>)>,
    /// Keys and values that each insert overwrites.
    pub(crate) changed: Vec<(Vec<u8>, Vec<u8>)>,
    /// Keys that each insert removes, of the form of an added one.
    pub(crate) removed: Vec<Vec<u8>>,
}

impl Shape {
    /// Reads it from a log in a separate directory.
    pub(crate) async fn read(base: &BaseDirectory) -> Self {
        let directory = base.create();
        let mut before = BTreeMap::new();
        let mut after = BTreeMap::new();
        for inserts in [INSERTS, 1] {
            let hosting = LocalService::open(directory.path(), Durability::None, WINDOW_BYTES);
            hosting.create(INDEX).await;
            for _ in 0..inserts {
                hosting.insert(insertion(&[0.5; WIDTH], None)).await;
            }
            drop(hosting);
            before = std::mem::replace(&mut after, content(&directory.path().join(STORE)));
        }
        let mut shape = Shape::default();
        for (key, value) in &after {
            match before.get(key) {
                None => shape.added.push((key.clone(), value.clone())),
                Some(old) if old != value => shape.changed.push((key.clone(), value.clone())),
                Some(_) => {}
            }
        }
        let gone = before.into_keys().filter(|key| !after.contains_key(key));
        shape.removed.extend(gone);
        shape
    }

    /// Its size in bytes.
    pub(crate) fn bytes(&self) -> usize {
        let written = self.added.iter().chain(&self.changed);
        let written: usize = written.map(|(key, value)| key.len() + value.len()).sum();
        written + self.removed.iter().map(Vec::len).sum::<usize>()
    }
}

/// The whole content of a store.
fn content(store: &Path) -> BTreeMap<Vec<u8>, Vec<u8>> {
    let database = Database::builder(store).open().expect("a store");
    let keyspace = database.keyspace(KEYSPACE, KeyspaceCreateOptions::default);
    let keyspace = keyspace.expect("a keyspace");
    let snapshot = database.snapshot();
    let pairs = snapshot.iter(&keyspace).map(|pair| {
        let (key, value) = pair.into_inner().expect("a pair");
        (key.to_vec(), value.to_vec())
    });
    pairs.collect()
}
