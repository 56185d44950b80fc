//! Restores an index from the points of another.

use std::sync::Arc;

use parking_lot::MutexGuard;
use tracing::{info, warn};
use wayfold_index::Space;
use wayfold_proto::v1::PayloadEncoding;

use super::{Host, Hosted, IndexLimit, IndexState, Registry, RegistryError, loading::Loader};
use crate::log::{
    Effects, Entry, Log, LogError, Origin, PointWriter, Record, RunId, Sessions, StoredPoint, Uid,
};

/// An index that is being restored. If it is dropped before [`Registry::host`], nothing is left behind.
pub struct Restore {
    pub(super) host: Arc<Host>,
    pub(super) entry: Entry,
    pub(super) origin: Origin,
    pub(super) stored: Box<dyn PointWriter>,
    pub(super) loader: Loader,
    /// None if it takes the place of an index, which counts already.
    pub(super) counted: Option<Counted>,
}

/// The name of an index that is being restored counts towards the limits until this is dropped.
pub(super) struct Counted {
    host: Arc<Host>,
    name: String,
}

impl Drop for Counted {
    fn drop(&mut self) {
        let mut restoring = self.host.restoring.lock();
        if let Some(at) = restoring.iter().position(|name| *name == self.name) {
            restoring.swap_remove(at);
        }
    }
}

/// While this lives, this server takes no mutation of a restored index: no other server has its points yet.
#[must_use]
pub(crate) struct AwaitedCopy {
    host: Arc<Host>,
    uid: Uid,
}

impl Drop for AwaitedCopy {
    fn drop(&mut self) {
        self.host.uncopied.lock().retain(|uid| *uid != self.uid);
    }
}

impl Registry {
    /// Begins to restore an index as a copy of another, under a new uid. [`RegistryError::Taken`] if the name is taken,
    /// [`RegistryError::TooManyIndexes`] if there are as many indices as `limits` allow. [`Registry::host`] checks the name
    /// again. Blocks on the log.
    pub fn restore(
        &self,
        name: &str,
        (space, payload_encoding): (Space, PayloadEncoding),
        limits: Vec<IndexLimit>,
        origin: Origin,
    ) -> Result<Restore, RegistryError> {
        self.host.watermarks.admit(0)?;
        let counted = Some(self.count(name, &limits)?);
        let entry = Entry {
            uid: Uid::unique(),
            name: name.into(),
            space,
            payload_encoding,
        };
        let restore = Restore::begin(&self.host, entry, origin, false);
        let restore = restore.map_err(|why| why.of_copy(self.is_shared()))?;
        Ok(Restore { counted, ..restore })
    }

    /// Hosts a restored index that has all its points, with these writer sessions. Blocks on the log and on building
    /// the forest.
    pub fn host(&self, restore: Restore, sessions: Sessions) -> Result<Arc<Hosted>, RegistryError> {
        let Restore {
            host,
            entry,
            origin,
            stored,
            loader,
            counted,
        } = restore;
        let points = loader.len;
        let loaded = loader.finish(origin.revision).map_err(unloaded)?;
        let mut change = self.change_lock.lock();
        self.check_free(&entry.name)?;
        // A copy has another uid, so no call to the original is repeated here.
        stored.finish(sessions, Vec::new())?;
        if host.log.journal.is_shared() {
            // A shared journal answers late or never. Of two restores of a name one claims it.
            let publish = || publish(&host.log, host.run, &entry, None, origin);
            let published = MutexGuard::unlocked(&mut change, publish);
            published.map_err(|error| match error {
                LogError::NameTaken { .. } => RegistryError::Taken,
                error => error.into(),
            })?;
            // The maintenance may have adopted the claimed name already.
            if let Some(hosted) = self.by_uid(entry.uid) {
                return Ok(hosted);
            }
        }
        let view = host.log.points.view(entry.uid)?;
        let hosted = Hosted::new(&host, &entry, loaded, view, Vec::new());
        info!(index = entry.name, uid = %entry.uid, revision = origin.revision, points, "restored an index");
        let state = IndexState::Hosted(Arc::clone(&hosted));
        self.change(|indexes| {
            drop(counted);
            indexes.insert(entry.name, state)
        });
        Ok(hosted)
    }

    /// Counts an index from now on, if its name is free and there is room for it.
    fn count(&self, name: &str, limits: &[IndexLimit]) -> Result<Counted, RegistryError> {
        let _change = self.change_lock.lock();
        self.check_free(name)?;
        self.check_limits(limits)?;
        self.host.restoring.lock().push(name.into());
        Ok(Counted {
            host: Arc::clone(&self.host),
            name: name.into(),
        })
    }

    fn check_free(&self, name: &str) -> Result<(), RegistryError> {
        match self.indexes.read().contains_key(name) {
            true => Err(RegistryError::Taken),
            false => Ok(()),
        }
    }

    /// Fails if the indices, those that are being restored included, leave no room for another one.
    pub(super) fn check_limits(&self, limits: &[IndexLimit]) -> Result<(), RegistryError> {
        let indexes = self.indexes.read();
        let restoring = self.host.restoring.lock();
        // The maintenance of a cluster may serve a restored index before its restore ends.
        let restoring = restoring.iter().filter(|name| !indexes.contains_key(*name));
        let names = indexes.keys().chain(restoring);
        let check = |limit: &IndexLimit| limit.check(names.clone());
        limits.iter().try_for_each(check)
    }
}

/// Publishes an index that the point store has from a restore: its journal begins behind the origin, and the index gets its
/// name last. So a server that ends before leaves an index without a name, which no call can reach. `replaced` takes the name from
/// the index that has it.
pub(crate) fn publish(
    log: &Log,
    run: RunId,
    entry: &Entry,
    replaced: Option<Uid>,
    origin: Origin,
) -> Result<(), LogError> {
    let fence = Record::made_by(
        run,
        origin.position(),
        Effects::new(entry.space.coordinates()),
    );
    let published = log.journal.begin(entry.uid, Arc::new(fence));
    let is_begun = published.is_ok();
    let claimed = published.and_then(|()| log.catalogue.claim(entry, replaced));
    if let Err(error) = &claimed {
        match !is_begun || matches!(error, LogError::NameTaken { .. }) {
            true => {
                if let Err(error) = log.catalogue.delete(entry.uid) {
                    warn!(index = entry.name, uid = %entry.uid, %error, "cannot remove an index that was not restored");
                }
            }
            // If the answer was lost, the index appears later.
            false => {
                warn!(index = entry.name, uid = %entry.uid, %error, "it is unknown whether an index was restored");
            }
        }
    }
    claimed
}

impl Restore {
    /// `replaces` is true if the point store has points under the uid.
    pub(super) fn begin(
        host: &Arc<Host>,
        entry: Entry,
        origin: Origin,
        replaces: bool,
    ) -> Result<Self, RegistryError> {
        let stored = host.log.points.restore(entry.clone(), origin, replaces)?;
        Ok(Self {
            stored,
            loader: Loader::new(host, &entry),
            host: Arc::clone(host),
            entry,
            origin,
            counted: None,
        })
    }

    /// Refuses mutations of the index until the result is dropped. Call it before [`Registry::host`], which gives the index its
    /// name.
    pub(crate) fn await_copy(&self) -> AwaitedCopy {
        let (host, uid) = (Arc::clone(&self.host), self.entry.uid);
        host.uncopied.lock().push(uid);
        AwaitedCopy { host, uid }
    }

    /// The space of the index.
    pub(crate) fn space(&self) -> &Space {
        &self.entry.space
    }

    /// The bytes of the payloads so far; 0 if they are not counted.
    pub fn payload_bytes(&self) -> u64 {
        self.loader.payload_sizes.total()
    }

    /// Takes in about `bytes` more, or refuses them.
    pub(crate) fn admit(&self, bytes: u64) -> Result<(), RegistryError> {
        Ok(self.host.watermarks.admit(bytes)?)
    }

    /// Adds the next points, by ascending id: canonical rows of the space with ids below the origin's next id. Blocks
    /// on the log.
    pub fn add(&mut self, points: &[StoredPoint]) -> Result<(), RegistryError> {
        let bytes = |point: &StoredPoint| 8 * point.state.len() + point.payload.len();
        let bytes: usize = points.iter().map(bytes).sum();
        self.admit(bytes as u64)?;
        self.stored.add(points)?;
        for point in points {
            self.loader.push(point)?;
            if let Some(full) = self.loader.full {
                return Err(full.into());
            }
        }
        Ok(())
    }
}

impl Hosted {
    /// True while an [`AwaitedCopy`] refuses its mutations.
    pub(crate) fn awaits_copy(&self) -> bool {
        self.host.uncopied.lock().contains(&self.uid())
    }
}

/// The error of a restore: one that does not fit is refused like any other write, and no index of it is kept.
pub(super) fn unloaded(error: RegistryError) -> RegistryError {
    match error {
        RegistryError::NotLoaded { full, .. } => full.into(),
        error => error,
    }
}
