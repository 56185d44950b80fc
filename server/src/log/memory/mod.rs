//! A log in memory: nothing survives the process.

mod store;
mod versions;

use std::{collections::BTreeMap, sync::Arc};

use futures_util::{FutureExt, future::BoxFuture};
use parking_lot::RwLock;

use super::{Effects, Entry, Log, LogError, Record, Uid, View};
use store::Store;

/// A [`Log`] in memory. It is synced as soon as it is appended to, as durable as this log makes anything.
#[derive(Default)]
pub struct MemoryLog {
    indexes: RwLock<BTreeMap<Uid, Hosted>>,
}

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
        let mut indexes = self.indexes.write();
        if indexes.contains_key(&entry.uid) {
            return Err(LogError::UidTaken { uid: entry.uid });
        }
        let store = Arc::new(Store::new(entry.uid));
        indexes.insert(entry.uid, Hosted { entry, store });
        Ok(())
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

    fn synced(&self, _uid: Uid, _revision: u64) -> BoxFuture<'static, Result<(), LogError>> {
        std::future::ready(Ok(())).boxed()
    }

    fn tail(&self, uid: Uid, after: Option<u64>) -> Result<Vec<Arc<Record>>, LogError> {
        self.store(uid)?.tail(after)
    }

    fn points(&self, uid: Uid) -> Result<Arc<dyn View>, LogError> {
        Ok(self.store(uid)?.pin())
    }

    fn trim(&self, uid: Uid, keep_bytes: usize) -> Result<(), LogError> {
        self.store(uid)?.trim(keep_bytes);
        Ok(())
    }
}
