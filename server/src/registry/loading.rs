//! Builds the forest of an index from its points, in the memory that there is. An index that does not fit is loaded later.

use std::sync::Arc;

use parking_lot::MutexGuard;
use tracing::info;
use wayfold_index::{ApplyError, Forest, Points, PointsError, Space};

use super::{Host, IndexState, PayloadSizes, Registry, RegistryError, replay};
use crate::{
    log::{Entry, LogError, StoredPoint, Uid},
    watermark::WatermarkExceeded,
};

/// Loading logs its progress once per this many points.
const PROGRESS_POINTS: usize = 1_000_000;

/// Memory is checked each time that the points that were read take this much more.
const CHECKED_BYTES: usize = 4 * 1024 * 1024;

/// The bytes that a point takes in each of its forms: the rows that are read, and a tree.
pub(super) fn point_bytes(space: &Space) -> usize {
    8 * space.coordinates() + 32
}

/// About the bytes that loading this many points takes.
fn loaded_bytes(space: &Space, points: usize) -> u64 {
    (points * point_bytes(space) + CHECKED_BYTES) as u64
}

impl Registry {
    /// Loads the indices that were not loaded, as far as there is memory for them now. Blocks.
    pub fn load_rest(&self) {
        let entries = {
            // A shared catalogue creates and deletes indices of the point store while it is read.
            let _change = self.change_lock.lock();
            self.host.log.catalogue.indexes()
        };
        let Ok(entries) = entries else {
            return;
        };
        for entry in &entries {
            let change = self.change_lock.lock();
            // The index may have been deleted since it was listed.
            let state = self.indexes.read().get(&entry.name).cloned();
            let state = state.filter(|state| state.uid() == entry.uid);
            if state.is_some_and(|state| self.is_loadable(&state)) {
                let state = replay::replay_or_damaged(&self.host, entry);
                self.change(|indexes| indexes.insert(entry.name.clone(), state));
            }
            // A change that waits goes before the next index, which may take long to load.
            MutexGuard::unlock_fair(change);
        }
    }

    /// True if there is memory now for an index that was not loaded.
    pub(super) fn is_any_loadable(&self) -> bool {
        let states = self.indexes.read();
        states.values().any(|state| self.is_loadable(state))
    }

    fn is_loadable(&self, state: &IndexState) -> bool {
        match state {
            IndexState::Damaged(_, RegistryError::NotLoaded { needed, .. }) => {
                let memory = self.host.watermarks.memory.as_ref();
                memory.is_none_or(|memory| memory.fits_at_start(*needed).is_ok())
            }
            IndexState::Hosted(_) | IndexState::Damaged(..) => false,
        }
    }
}

/// A forest that gets its points in the order of their ids, and the sizes of their payloads.
pub(super) struct Loader {
    host: Arc<Host>,
    entry: Entry,
    forest: Forest,
    /// The points that are not in the forest yet.
    points: Points,
    pub(super) payload_sizes: PayloadSizes,
    /// The number of all points.
    pub(super) len: usize,
    /// The number of those with a payload.
    payloads: usize,
    /// The id of the newest point.
    last: Option<u64>,
    /// The bound that the points exceed. Further points are only counted: the index is loaded once there is memory for all.
    pub(super) full: Option<WatermarkExceeded>,
}

impl Loader {
    pub(super) fn new(host: &Arc<Host>, entry: &Entry) -> Self {
        Self {
            host: Arc::clone(host),
            entry: entry.clone(),
            forest: host.options.forest(&entry.space),
            points: Points::new(entry.space.coordinates()),
            payload_sizes: PayloadSizes::new(host.options.counts_payloads),
            len: 0,
            payloads: 0,
            last: None,
            full: None,
        }
    }

    /// Adds a point.
    pub(super) fn push(&mut self, point: &StoredPoint) -> Result<(), LogError> {
        let damaged = |what| LogError::damaged_point(self.entry.uid, point.id, what);
        if point.state.len() != self.entry.space.coordinates() {
            return Err(damaged("its state has not the width of the space"));
        }
        if self.last.is_some_and(|last| last >= point.id) {
            return Err(damaged("it is stored twice"));
        }
        self.last = Some(point.id);
        self.len += 1;
        self.payloads += usize::from(!point.payload.is_empty());
        if self.full.is_none() {
            self.payload_sizes.set(point.id, point.payload.len());
            self.points.push_point(point.indexed());
            let checked_points = CHECKED_BYTES / point_bytes(&self.entry.space);
            if self.points.len().is_multiple_of(checked_points.max(1)) {
                self.make_room(point.modified)?;
            }
        }
        let points = self.len;
        if points.is_multiple_of(PROGRESS_POINTS) {
            info!(index = self.entry.name, points, "reading points");
        }
        Ok(())
    }

    /// Moves the points, of at most this revision, into the forest if there is not enough memory to build all of it at once
    /// later.
    fn make_room(&mut self, revision: u64) -> Result<(), LogError> {
        let Some(memory) = &self.host.watermarks.memory else {
            return Ok(());
        };
        let space = &self.entry.space;
        let bytes = (self.points.len() * point_bytes(space)) as u64;
        if memory.fits_at_start(4 * bytes).is_ok() {
            return Ok(());
        }
        let fits = memory.fits_at_start(bytes);
        let points = std::mem::replace(&mut self.points, Points::new(space.coordinates()));
        if let Err(full) = fits {
            // The memory of the points and sizes is free for other indices.
            self.forest = self.host.options.forest(space);
            self.payload_sizes = PayloadSizes::new(self.host.options.counts_payloads);
            self.full = Some(full);
            return Ok(());
        }
        let loaded = self.forest.load(&points);
        loaded.map_err(|error| damaged(self.entry.uid, revision, &points, &error))
    }

    /// The forest of all points at a revision, and the sizes of their payloads.
    pub(super) fn finish(mut self, revision: u64) -> Result<(Forest, PayloadSizes), RegistryError> {
        if !self.points.is_empty() {
            self.make_room(revision)?;
        }
        let Entry { uid, space, .. } = &self.entry;
        if let Some(full) = self.full {
            return Err(RegistryError::NotLoaded {
                points: self.len,
                needed: loaded_bytes(space, self.len) + self.payload_sizes.bytes_of(self.payloads),
                full,
            });
        }
        if revision > 0 {
            let applied = self.forest.apply(revision, &self.points, &[]);
            applied.map_err(|error| damaged(*uid, revision, &self.points, &error))?;
            drop(self.points);
            self.forest.settle_up_to(|| self.host.merge_rows(space));
        }
        Ok((self.forest, self.payload_sizes))
    }
}

/// The error of stored points that the forest refuses: they differ from the written ones.
fn damaged(uid: Uid, revision: u64, points: &Points, error: &ApplyError) -> LogError {
    match *error {
        ApplyError::Points(PointsError::State { row, .. }) => {
            let what = "its state is not a canonical state of the space";
            LogError::damaged_point(uid, points.id(row), what)
        }
        ApplyError::Points(PointsError::DuplicateId(id)) => {
            LogError::damaged_point(uid, id, "it is stored twice")
        }
        ApplyError::Points(PointsError::Width { .. } | PointsError::TooMany(_))
        | ApplyError::Revision { .. } => {
            LogError::damaged_record(uid, revision, "its points do not make a forest")
        }
    }
}

#[cfg(test)]
mod tests {
    use bytes::Bytes;

    use super::*;
    use crate::{
        log::MemoryLog,
        registry::RegistryOptions,
        testing::arm,
        watermark::{Resource, Usage, Watermark, Watermarks},
    };

    #[test]
    fn further_points_of_an_index_that_does_not_fit_take_no_memory() {
        let full = || {
            Ok(Usage {
                used: 100,
                high: 85,
                low: 80,
                limit: 100,
            })
        };
        let watermarks = Watermarks {
            memory: Some(Arc::new(Watermark::new(Resource::Memory, full))),
            disk: None,
        };
        let options = RegistryOptions {
            counts_payloads: true,
            ..RegistryOptions::default()
        };
        let registry = Registry::with_watermarks(Arc::new(MemoryLog::new()), options, watermarks);
        let entry = arm();
        let mut loader = Loader::new(&registry.host, &entry);
        let points = 2 * CHECKED_BYTES / point_bytes(&entry.space);
        let row: &[f64] = &[0.5];
        for id in 0..points as u64 {
            let point = StoredPoint {
                id,
                revision: 1,
                modified: 1,
                tag: 0,
                state: row.into(),
                payload: Bytes::from_static(b"edges"),
            };
            loader.push(&point).unwrap();
        }
        assert!(loader.full.is_some());
        assert_eq!(loader.payload_sizes.memory_bytes(), 0);
        let Err(RegistryError::NotLoaded {
            points: counted,
            needed,
            ..
        }) = loader.finish(1)
        else {
            panic!("it was loaded");
        };
        assert_eq!(counted, points);
        // It is loaded once there is memory for the sizes of the payloads too.
        assert!(needed > loaded_bytes(&entry.space, points) + 16 * points as u64);
    }
}
