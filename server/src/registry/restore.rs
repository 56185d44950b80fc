//! Restores an index from the points of another.

use std::sync::Arc;

use tracing::info;
use wayfold_index::{Points, Space};

use super::{Host, Hosted, IndexState, Registry, RegistryError, operations::Operations};
use crate::log::{Entry, Origin, Restoring, Sessions, StoredPoint, Uid};

/// An index that is being restored. If it is dropped before [`Registry::host`], nothing is left behind.
pub struct Restore {
    host: Arc<Host>,
    entry: Entry,
    origin: Origin,
    limit: usize,
    stored: Box<dyn Restoring>,
    points: Points,
}

impl Registry {
    /// Begins to restore an index as a copy of another, under a new uid. [`RegistryError::Taken`] if the name is taken,
    /// [`RegistryError::Full`] if the registry holds `limit` indices; [`Registry::host`] checks both again. Blocks on
    /// the log.
    pub fn restore(
        &self,
        name: &str,
        space: Space,
        limit: usize,
        origin: Origin,
    ) -> Result<Restore, RegistryError> {
        self.room_for(name, limit)?;
        let entry = Entry {
            uid: Uid::unique(),
            name: name.into(),
            space,
        };
        Ok(Restore {
            stored: self.host.log.points.restore(entry.clone(), origin)?,
            points: Points::new(entry.space.coordinates()),
            host: Arc::clone(&self.host),
            entry,
            origin,
            limit,
        })
    }

    /// Hosts a restored index that has all its points, with these writer sessions. Blocks on the log and on building
    /// the forest.
    pub fn host(&self, restore: Restore, sessions: Sessions) -> Result<Arc<Hosted>, RegistryError> {
        let Restore {
            host,
            entry,
            origin,
            limit,
            stored,
            points,
        } = restore;
        let mut forest = host.options.forest(&entry.space);
        if origin.revision > 0 {
            forest
                .apply(origin.revision, &points, &[])
                .expect("restored points are checked as they arrive");
            forest.settle();
        }
        let _change = self.change_lock.lock();
        self.room_for(&entry.name, limit)?;
        stored.finish(sessions)?;
        let view = host.log.points.view(entry.uid)?;
        let hosted = Hosted::new(&host, &entry, forest, view, Operations::new());
        info!(index = entry.name, uid = %entry.uid, revision = origin.revision, points = points.len(), "restored an index");
        let state = IndexState::Hosted(Arc::clone(&hosted));
        self.change(|indexes| indexes.insert(entry.name, state));
        Ok(hosted)
    }

    fn room_for(&self, name: &str, limit: usize) -> Result<(), RegistryError> {
        let indexes = self.indexes.read();
        if indexes.contains_key(name) {
            return Err(RegistryError::Taken);
        }
        if indexes.len() >= limit {
            return Err(RegistryError::Full { limit });
        }
        Ok(())
    }
}

impl Restore {
    /// Adds the next points, by ascending id: canonical rows of the space with ids below the origin's next id. Blocks
    /// on the log.
    pub fn add(&mut self, points: &[StoredPoint]) -> Result<(), RegistryError> {
        self.stored.add(points)?;
        for point in points {
            self.points.push_point(point.indexed());
        }
        Ok(())
    }
}
