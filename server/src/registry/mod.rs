//! The indices of the server by name, each with one writer and many readers.
//!
//! Architecture:
//! - A [`Hosted`] index is fed by the log alone: its [`Writer`] appends effects, applies the record to the forest, and
//!   publishes the outcome. Nothing else changes a forest, save merging, which changes no answer.
//! - Readers take the [`Published`] state, one frozen revision, and never wait for the writer.
//! - A mutation is evaluated by whoever holds the writer, and decided before it is committed; from the append to the
//!   publication nothing waits for the caller, so a dropped call has happened whole or not at all.
//! - The registry knows no requests, no limits and no transport.

mod error;
mod hosted;
mod merging;
mod operations;
mod replay;
mod writer;

use std::{collections::BTreeMap, ops::Bound, sync::Arc};

use parking_lot::RwLock;
use tokio::sync::Semaphore;
use tracing::info;
use wayfold_index::{Forest, ForestOptions, Space};

use crate::log::{Entry, Log, Uid};
pub use error::RegistryError;
pub use hosted::{Hosted, Published};
pub use operations::OperationWindow;
pub use writer::{WriteGuard, Writer};

/// How the registry hosts its indices.
#[derive(Clone, Copy, Debug)]
pub struct RegistryOptions {
    /// The sizes of the forests.
    pub forest: ForestOptions,
    /// How many merges run at once, over all indices.
    pub merge_threads: usize,
    /// About how many bytes of its newest records each index keeps, beside its points.
    pub window_bytes: usize,
}

impl Default for RegistryOptions {
    fn default() -> Self {
        Self {
            forest: ForestOptions::default(),
            merge_threads: 2,
            window_bytes: 4 * 1024 * 1024,
        }
    }
}

/// The indices of the server.
pub struct Registry {
    host: Arc<Host>,
    indexes: RwLock<BTreeMap<String, Arc<Hosted>>>,
}

/// What all indices share.
struct Host {
    log: Arc<dyn Log>,
    options: RegistryOptions,
    /// The turns of merges.
    merges: Semaphore,
}

impl Registry {
    /// A registry over `log` that hosts nothing yet: see [`Registry::replay`].
    pub fn new(log: Arc<dyn Log>, options: RegistryOptions) -> Self {
        let merges = Semaphore::new(options.merge_threads.max(1));
        Self {
            host: Arc::new(Host {
                log,
                options,
                merges,
            }),
            indexes: RwLock::default(),
        }
    }

    /// Hosts every index that the log holds. To be called once, before the first call is answered; with an empty log
    /// it does nothing.
    pub fn replay(&self) -> Result<(), RegistryError> {
        for entry in self.host.log.indexes()? {
            let hosted = replay::replay(&self.host, &entry)?;
            self.indexes.write().insert(entry.name, hosted);
        }
        Ok(())
    }

    /// The index of this name.
    pub fn get(&self, name: &str) -> Option<Arc<Hosted>> {
        self.indexes.read().get(name).cloned()
    }

    /// Up to `limit` indices with names after `after` (from the first if None), by name.
    pub fn page(&self, after: Option<&str>, limit: usize) -> Vec<Arc<Hosted>> {
        let start = after.map_or(Bound::Unbounded, Bound::Excluded);
        let indexes = self.indexes.read();
        let page = indexes.range::<str, _>((start, Bound::Unbounded));
        page.take(limit)
            .map(|(_, hosted)| Arc::clone(hosted))
            .collect()
    }

    /// Creates an index, or finds the one of this name with an equal space; says whether it was created.
    /// [`RegistryError::Exists`] if its space is another, [`RegistryError::Full`] if there are `limit` of them.
    pub fn create(
        &self,
        name: &str,
        space: Space,
        limit: usize,
    ) -> Result<(Arc<Hosted>, bool), RegistryError> {
        let mut indexes = self.indexes.write();
        if let Some(hosted) = indexes.get(name) {
            return if *hosted.space() == space {
                Ok((Arc::clone(hosted), false))
            } else {
                Err(RegistryError::Exists {
                    space: hosted.space().clone(),
                })
            };
        }
        if indexes.len() >= limit {
            return Err(RegistryError::Full { limit });
        }
        let entry = Entry {
            uid: Uid::unique(),
            name: name.into(),
            space,
        };
        self.host.log.create(entry.clone())?;
        let forest = Forest::new(entry.space.clone(), self.host.options.forest);
        let view = self.host.log.points(entry.uid)?;
        let hosted = Hosted::new(&self.host, &entry, Writer::new(forest, view));
        indexes.insert(entry.name, Arc::clone(&hosted));
        info!(index = name, uid = %entry.uid, space = %entry.space, "created an index");
        Ok((hosted, true))
    }

    /// Deletes the index of this name, if it has `uid` or `uid` is None. Whoever reads it goes on with what it has;
    /// whoever waits for it, or comes to write it, is told [`RegistryError::Deleted`].
    pub fn delete(&self, name: &str, uid: Option<&str>) -> Result<Uid, RegistryError> {
        let mut indexes = self.indexes.write();
        let hosted = match indexes.get(name) {
            Some(hosted) => Arc::clone(hosted),
            None => return Err(RegistryError::Deleted),
        };
        if uid.is_some_and(|uid| uid != hosted.uid_text()) {
            return Err(RegistryError::OtherUid {
                found: hosted.uid(),
            });
        }
        self.host.log.delete(hosted.uid())?;
        indexes.remove(name);
        hosted.close(RegistryError::Deleted);
        info!(index = name, uid = %hosted.uid(), "deleted an index");
        Ok(hosted.uid())
    }
}
