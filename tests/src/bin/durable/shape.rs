//! The writes of one insert of one state, read off a log of ours: the keys and values of its batch.

use std::{collections::BTreeMap, path::Path};

use fjall::{Database, KeyspaceCreateOptions, Readable};
use wayfold_server::log::Durability;

use crate::{
    INDEX, WIDTH,
    place::Place,
    service::{Hosting, insertion},
};

/// The directory in which our log keeps its store, and the keyspace that holds all of it.
pub(crate) const STORE: &str = "store";
pub(crate) const KEYSPACE: &str = "wayfold";
/// Records that are kept while the shape is read, in bytes: few, so that each insert also removes one.
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
    /// Reads it off a log in a directory of its own.
    pub(crate) async fn read(place: &Place) -> Self {
        let directory = place.directory();
        let mut before = BTreeMap::new();
        let mut after = BTreeMap::new();
        for inserts in [INSERTS, 1] {
            let hosting = Hosting::open(directory.path(), Durability::None, WINDOW_BYTES);
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

    /// How many bytes it has.
    pub(crate) fn bytes(&self) -> usize {
        let written = self.added.iter().chain(&self.changed);
        let written: usize = written.map(|(key, value)| key.len() + value.len()).sum();
        written + self.removed.iter().map(Vec::len).sum::<usize>()
    }
}

/// All that a store holds.
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
