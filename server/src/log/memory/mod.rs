//! A log in memory: nothing survives the process.

mod store;
mod versions;

use std::{
    collections::{BTreeMap, btree_map},
    sync::Arc,
};

use futures_util::{FutureExt, future::BoxFuture};
use parking_lot::RwLock;

use super::{
    Effects, Entry, Keep, Log, LogError, Operation, Origin, Record, Restoring, StoredPoint, Uid,
    View,
};
use store::Store;

/// A [`Log`] in memory. It is synced as soon as it is appended to, as durable as this log makes anything.
#[derive(Default)]
pub struct MemoryLog {
    indexes: Arc<Indexes>,
}

type Indexes = RwLock<BTreeMap<Uid, Hosted>>;

struct Hosted {
    entry: Entry,
    store: Arc<Store>,
}

impl MemoryLog {
    /// A log without indices.
    pub fn new() -> Self {
        Self::default()
    }

    fn store(&self, uid: Uid) -> Result<Arc<Store>, LogError> {
        match self.indexes.read().get(&uid) {
            Some(hosted) => Ok(Arc::clone(&hosted.store)),
            None => Err(LogError::UnknownIndex { uid }),
        }
    }
}

impl Log for MemoryLog {
    fn indexes(&self) -> Result<Vec<Entry>, LogError> {
        let indexes = self.indexes.read();
        Ok(indexes
            .values()
            .map(|hosted| hosted.entry.clone())
            .collect())
    }

    fn create(&self, entry: Entry) -> Result<(), LogError> {
        add(&self.indexes, entry, Origin::START, Vec::new())
    }

    fn restore(&self, entry: Entry, origin: Origin) -> Result<Box<dyn Restoring>, LogError> {
        Ok(Box::new(Copy {
            indexes: Arc::clone(&self.indexes),
            entry,
            origin,
            points: Vec::new(),
        }))
    }

    fn delete(&self, uid: Uid) -> Result<(), LogError> {
        match self.indexes.write().remove(&uid) {
            Some(_) => Ok(()),
            None => Err(LogError::UnknownIndex { uid }),
        }
    }

    fn append(&self, uid: Uid, expected: u64, effects: Effects) -> Result<Arc<Record>, LogError> {
        self.store(uid)?.append(expected, effects)
    }

    fn synced(&self, _uid: Uid, revision: u64) -> BoxFuture<'static, Result<u64, LogError>> {
        std::future::ready(Ok(revision)).boxed()
    }

    fn tail(
        &self,
        uid: Uid,
        after: Option<u64>,
        most: usize,
    ) -> Result<Vec<Arc<Record>>, LogError> {
        self.store(uid)?.tail(after, most)
    }

    fn points(&self, uid: Uid) -> Result<Arc<dyn View>, LogError> {
        Ok(self.store(uid)?.pin())
    }

    fn operations(&self, uid: Uid) -> Result<Vec<Arc<Operation>>, LogError> {
        Ok(self.store(uid)?.operations())
    }

    fn trim(&self, uid: Uid, keep: &Keep) -> Result<(), LogError> {
        self.store(uid)?.trim(keep);
        Ok(())
    }
}

fn add(
    indexes: &Indexes,
    entry: Entry,
    origin: Origin,
    points: Vec<Arc<StoredPoint>>,
) -> Result<(), LogError> {
    let store = Arc::new(Store::new(entry.uid, origin, points));
    match indexes.write().entry(entry.uid) {
        btree_map::Entry::Occupied(_) => Err(LogError::UidTaken { uid: entry.uid }),
        btree_map::Entry::Vacant(place) => {
            place.insert(Hosted { entry, store });
            Ok(())
        }
    }
}

/// An index in the making.
struct Copy {
    indexes: Arc<Indexes>,
    entry: Entry,
    origin: Origin,
    points: Vec<Arc<StoredPoint>>,
}

impl Restoring for Copy {
    fn add(&mut self, points: &[StoredPoint]) -> Result<(), LogError> {
        self.points.extend(points.iter().cloned().map(Arc::new));
        Ok(())
    }

    fn finish(self: Box<Self>) -> Result<(), LogError> {
        add(&self.indexes, self.entry, self.origin, self.points)
    }
}
