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
mod maintenance;
mod merging;
mod operations;
mod recent;
mod replay;
mod restore;
mod writer;

use std::{collections::BTreeMap, ops::Bound, sync::Arc, time::Duration};

use parking_lot::{Mutex, RwLock};
use tokio::sync::{Semaphore, watch};
use tracing::info;
use wayfold_index::{Forest, ForestOptions, Space};

use crate::log::{Entry, Log, LogError, Uid};
pub use error::RegistryError;
pub use hosted::{Hosted, Published};
pub use operations::OperationWindow;
pub use restore::Restore;
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
    /// For how long it keeps them.
    pub window: Duration,
}

impl Default for RegistryOptions {
    fn default() -> Self {
        Self {
            forest: ForestOptions::default(),
            merge_threads: 2,
            window_bytes: 64 * 1024 * 1024,
            window: Duration::from_secs(3600),
        }
    }
}

/// The indices of the server.
pub struct Registry {
    host: Arc<Host>,
    indexes: RwLock<BTreeMap<String, IndexState>>,
    /// Held by who creates, deletes, restores or recovers indices, so that readers need not wait for the log meanwhile.
    change_lock: Mutex<()>,
    /// Told of every change of what the names stand for.
    changed: watch::Sender<()>,
}

/// What a name stands for.
#[derive(Clone)]
enum IndexState {
    Hosted(Arc<Hosted>),
    /// An index that could not be replayed, and why. It can be deleted.
    Damaged(Uid, RegistryError),
}

impl IndexState {
    fn hosted(&self) -> Result<&Arc<Hosted>, RegistryError> {
        match self {
            IndexState::Hosted(hosted) => Ok(hosted),
            IndexState::Damaged(_, why) => Err(why.clone()),
        }
    }
}

/// An index as it is listed.
pub enum Listed {
    /// One that is hosted.
    Hosted(Arc<Hosted>),
    /// One that cannot be read.
    Damaged {
        /// Its name.
        name: String,
        /// Its uid.
        uid: Uid,
        /// Why every call for it fails.
        why: RegistryError,
    },
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
            change_lock: Mutex::new(()),
            changed: watch::Sender::new(()),
        }
    }

    /// Hosts every index that the log holds. To be called once, before the first call is answered; with an empty log
    /// it does nothing. An index that is damaged does not keep the others from being hosted: [`Registry::get`] tells.
    pub fn replay(&self) -> Result<(), RegistryError> {
        let entries = self.host.log.indexes()?;
        for (done, entry) in entries.iter().enumerate() {
            let state = replay::replay_or_damaged(&self.host, entry);
            self.change(|indexes| indexes.insert(entry.name.clone(), state));
            if (done + 1).is_multiple_of(1000) {
                info!(done = done + 1, of = entries.len(), "replaying");
            }
        }
        self.add_lost();
        info!(indexes = entries.len(), "replayed the log");
        Ok(())
    }

    /// Tells of every change of what the names stand for from now on.
    pub fn changes(&self) -> watch::Receiver<()> {
        self.changed.subscribe()
    }

    /// Changes what the names stand for.
    fn change<T>(&self, change: impl FnOnce(&mut BTreeMap<String, IndexState>) -> T) -> T {
        let changed = change(&mut self.indexes.write());
        self.changed.send_replace(());
        changed
    }

    /// Takes note of the indices of which nothing is left, unless their names stand for others.
    fn add_lost(&self) {
        for gone in self.host.log.gone() {
            let damaged = IndexState::Damaged(gone.uid, RegistryError::Log(gone.why));
            self.change(|indexes| {
                indexes.entry(gone.name).or_insert(damaged);
            });
        }
    }

    /// The index of this name: [`RegistryError::Deleted`] if there is none, or why it cannot be read.
    pub fn get(&self, name: &str) -> Result<Arc<Hosted>, RegistryError> {
        match self.indexes.read().get(name) {
            Some(state) => state.hosted().cloned(),
            None => Err(self.unopened().unwrap_or(RegistryError::Deleted)),
        }
    }

    /// Why the log is not open, if so: then it may hold what is not known by name.
    fn unopened(&self) -> Option<RegistryError> {
        let not_open =
            |why: &LogError| matches!(why, LogError::Unopened { .. } | LogError::Shut { .. });
        let why = self.host.log.failure().filter(not_open);
        why.map(RegistryError::Log)
    }

    /// Up to `limit` indices with names after `after` (from the first if None), by name; also those that are damaged.
    /// Fails if none is known and the log is not open.
    pub fn page(&self, after: Option<&str>, limit: usize) -> Result<Vec<Listed>, RegistryError> {
        let start = after.map_or(Bound::Unbounded, Bound::Excluded);
        let indexes = self.indexes.read();
        if indexes.is_empty()
            && let Some(why) = self.unopened()
        {
            return Err(why);
        }
        let page = indexes.range::<str, _>((start, Bound::Unbounded));
        let listed = page.take(limit).map(|(name, state)| match state {
            IndexState::Hosted(hosted) => Listed::Hosted(Arc::clone(hosted)),
            IndexState::Damaged(uid, why) => Listed::Damaged {
                name: name.clone(),
                uid: *uid,
                why: why.clone(),
            },
        });
        Ok(listed.collect())
    }

    /// Creates an index, or finds the one of this name with an equal space; says whether it was created.
    /// [`RegistryError::Exists`] if its space is another, [`RegistryError::Full`] if there are `limit` of them. It
    /// blocks while the log works.
    pub fn create(
        &self,
        name: &str,
        space: Space,
        limit: usize,
    ) -> Result<(Arc<Hosted>, bool), RegistryError> {
        let _change = self.change_lock.lock();
        match self.get(name) {
            Ok(hosted) if *hosted.space() == space => return Ok((hosted, false)),
            Ok(hosted) => {
                return Err(RegistryError::Exists {
                    space: hosted.space().clone(),
                });
            }
            Err(RegistryError::Deleted) => {}
            Err(damaged) => return Err(damaged),
        }
        if self.indexes.read().len() >= limit {
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
        let state = IndexState::Hosted(Arc::clone(&hosted));
        self.change(|indexes| indexes.insert(entry.name, state));
        info!(index = name, uid = %entry.uid, space = %entry.space, "created an index");
        Ok((hosted, true))
    }

    /// Deletes the index of this name, if it has `uid` or `uid` is None. Whoever reads it goes on with what it has;
    /// whoever waits for it, or comes to write it, is told [`RegistryError::Deleted`]. It blocks while the log works.
    pub fn delete(&self, name: &str, uid: Option<&str>) -> Result<Uid, RegistryError> {
        let _change = self.change_lock.lock();
        let state = self.indexes.read().get(name).cloned();
        let found = match state.as_ref().ok_or(RegistryError::Deleted)? {
            IndexState::Hosted(hosted) => hosted.uid(),
            IndexState::Damaged(uid, _) => *uid,
        };
        if uid.is_some_and(|uid| uid != found.to_string()) {
            return Err(RegistryError::OtherUid { found });
        }
        self.host.log.delete(found)?;
        self.change(|indexes| indexes.remove(name));
        if let Some(IndexState::Hosted(hosted)) = state {
            hosted.close(RegistryError::Deleted);
        }
        info!(index = name, uid = %found, "deleted an index");
        Ok(found)
    }
}
