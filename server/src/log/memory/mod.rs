//! A log in memory: nothing survives the process.

mod store;
mod view;

use std::{
    collections::{BTreeMap, btree_map},
    sync::Arc,
};

use futures_util::{StreamExt, stream};
use imbl::OrdMap;
use parking_lot::RwLock;

use super::{
    Catalogue, Entry, Journal, LogError, Operation, Origin, PointStore, PointWriter, Receipt,
    Record, RecordStream, Retention, Sessions, StoredPoint, Uid, View, Window,
};
use store::Store;

/// A log in memory. A submitted record is at once as durable as this log can make it.
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

impl Journal for MemoryLog {
    fn submit(&self, uid: Uid, record: Arc<Record>) -> Result<Receipt, LogError> {
        self.store(uid)?.submit(record)?;
        Ok(Receipt::Accepted)
    }

    fn follow(&self, uid: Uid, after: u64) -> RecordStream {
        match self.store(uid) {
            Ok(store) => store.follow(after),
            Err(error) => stream::once(async { Err(error) }).boxed(),
        }
    }

    fn read(
        &self,
        uid: Uid,
        after: Option<u64>,
        max_bytes: usize,
    ) -> Result<Vec<Arc<Record>>, LogError> {
        self.store(uid)?.read(after, max_bytes)
    }

    fn newest(&self, uid: Uid) -> Result<u64, LogError> {
        Ok(self.view(uid)?.revision())
    }
}

impl PointStore for MemoryLog {
    fn apply(&self, uid: Uid, records: &[Arc<Record>]) -> Result<Arc<dyn View>, LogError> {
        self.store(uid)?.apply(records)
    }

    fn view(&self, uid: Uid) -> Result<Arc<dyn View>, LogError> {
        Ok(self.store(uid)?.view())
    }

    fn trim(&self, uid: Uid, retention: &Retention) -> Result<(), LogError> {
        self.store(uid)?.trim(retention);
        Ok(())
    }

    fn window(&self, uid: Uid) -> Result<Window, LogError> {
        Ok(self.store(uid)?.window())
    }

    fn operations(&self, uid: Uid) -> Result<Vec<Arc<Operation>>, LogError> {
        Ok(self.store(uid)?.operations())
    }

    fn restore(
        &self,
        entry: Entry,
        origin: Origin,
        replaces: bool,
    ) -> Result<Box<dyn PointWriter>, LogError> {
        if replaces {
            self.store(entry.uid)?;
        }
        Ok(Box::new(MemoryPointWriter {
            indexes: Arc::clone(&self.indexes),
            entry,
            origin,
            points: OrdMap::new(),
            replaces,
        }))
    }
}

impl Catalogue for MemoryLog {
    fn indexes(&self) -> Result<Vec<Entry>, LogError> {
        let indexes = self.indexes.read();
        Ok(indexes
            .values()
            .map(|hosted| hosted.entry.clone())
            .collect())
    }

    fn create(&self, entry: Entry) -> Result<(), LogError> {
        let (origin, sessions) = (Origin::START, Sessions::default());
        let store = Store::new(entry.uid, origin, OrdMap::new(), sessions);
        add(&self.indexes, entry, store)
    }

    fn delete(&self, uid: Uid) -> Result<(), LogError> {
        match self.indexes.write().remove(&uid) {
            Some(hosted) => {
                hosted.store.close(LogError::UnknownIndex { uid });
                Ok(())
            }
            None => Err(LogError::UnknownIndex { uid }),
        }
    }
}

fn add(indexes: &Indexes, entry: Entry, store: Store) -> Result<(), LogError> {
    let store = Arc::new(store);
    match indexes.write().entry(entry.uid) {
        btree_map::Entry::Occupied(_) => Err(LogError::UidTaken { uid: entry.uid }),
        btree_map::Entry::Vacant(place) => {
            place.insert(Hosted { entry, store });
            Ok(())
        }
    }
}

/// An index that is being restored.
struct MemoryPointWriter {
    indexes: Arc<Indexes>,
    entry: Entry,
    origin: Origin,
    points: OrdMap<u64, Arc<StoredPoint>>,
    /// True if it takes the place of the index with its uid.
    replaces: bool,
}

impl PointWriter for MemoryPointWriter {
    fn add(&mut self, points: &[StoredPoint]) -> Result<(), LogError> {
        let points = points.iter().cloned();
        self.points
            .extend(points.map(|point| (point.id, Arc::new(point))));
        Ok(())
    }

    fn finish(
        self: Box<Self>,
        sessions: Sessions,
        operations: Vec<Arc<Operation>>,
    ) -> Result<(), LogError> {
        let (uid, origin) = (self.entry.uid, self.origin);
        origin.has_room_for(uid, operations.len())?;
        let store = Store::new(uid, origin, self.points, sessions);
        store.remember(operations);
        if !self.replaces {
            return add(&self.indexes, self.entry, store);
        }
        let mut indexes = self.indexes.write();
        let Some(hosted) = indexes.get_mut(&uid) else {
            return Err(LogError::UnknownIndex { uid });
        };
        hosted.store.supersede(origin.position())?;
        hosted.store = Arc::new(store);
        Ok(())
    }
}
