//! Builds the forest of an index from its points, in the memory that there is.

use std::sync::Arc;

use wayfold_index::{ApplyError, Forest, Points, Space};

use super::{Host, PayloadSizes};
use crate::{log::StoredPoint, watermark::WatermarkExceeded};

/// Memory is checked each time that the points that were read take this much more.
const CHECKED_BYTES: usize = 4 * 1024 * 1024;

/// The bytes that a point takes in each of its forms: the rows that are read, and a tree.
fn point_bytes(space: &Space) -> usize {
    8 * space.coordinates() + 32
}

/// About the bytes that loading this many points takes.
pub(super) fn loaded_bytes(space: &Space, points: usize) -> u64 {
    (points * point_bytes(space) + CHECKED_BYTES) as u64
}

impl Host {
    /// The greatest number of points that a merge may copy in its share of the memory that is left, above the
    /// watermarks too: the old levels, their points as rows and the new level exist at a time.
    pub(super) fn merge_rows(&self, space: &Space) -> usize {
        let left = self
            .watermarks
            .memory
            .as_ref()
            .and_then(|it| it.remaining());
        let bytes = 3 * point_bytes(space) * self.options.merge_threads.max(1);
        let rows = |left: u64| left / bytes as u64;
        left.map_or(usize::MAX, |left| {
            usize::try_from(rows(left)).unwrap_or(usize::MAX)
        })
    }
}

/// The error of a forest that is not built.
pub(super) enum LoadError {
    /// It would take more memory than there is.
    Full(WatermarkExceeded),
    /// These points are refused.
    Refused(Box<Points>, ApplyError),
}

/// A forest that gets its points in the order of their ids, and the sizes of their payloads.
pub(super) struct Loader {
    host: Arc<Host>,
    forest: Forest,
    /// The points that are not in the forest yet.
    points: Points,
    pub(super) payload_sizes: PayloadSizes,
    /// The number of all points.
    pub(super) len: usize,
    /// The bound that the points exceed. Further points are only counted.
    full: Option<WatermarkExceeded>,
}

impl Loader {
    pub(super) fn new(host: &Arc<Host>, space: &Space) -> Self {
        Self {
            host: Arc::clone(host),
            forest: host.options.forest(space),
            points: Points::new(space.coordinates()),
            payload_sizes: PayloadSizes::new(host.options.counts_payloads),
            len: 0,
            full: None,
        }
    }

    /// Adds a point.
    pub(super) fn push(&mut self, point: &StoredPoint) -> Result<(), LoadError> {
        self.len += 1;
        self.payload_sizes.set(point.id, point.payload.len());
        if self.full.is_some() {
            return Ok(());
        }
        self.points.push_point(point.indexed());
        let checked_points = CHECKED_BYTES / point_bytes(self.forest.space());
        match self.points.len().is_multiple_of(checked_points.max(1)) {
            true => self.make_room(),
            false => Ok(()),
        }
    }

    /// Moves the points into the forest if there is not enough memory to build all of it at once later.
    fn make_room(&mut self) -> Result<(), LoadError> {
        let Some(memory) = &self.host.watermarks.memory else {
            return Ok(());
        };
        let bytes = (self.points.len() * point_bytes(self.forest.space())) as u64;
        if memory.fits_at_start(4 * bytes).is_ok() {
            return Ok(());
        }
        let fits = memory.fits_at_start(bytes);
        let space = self.forest.space();
        let points = std::mem::replace(&mut self.points, Points::new(space.coordinates()));
        if let Err(full) = fits {
            // The memory of the points is free for other indices.
            self.forest = self.host.options.forest(space);
            self.full = Some(full);
            return Err(LoadError::Full(full));
        }
        match self.forest.load(&points) {
            Ok(()) => Ok(()),
            Err(error) => Err(LoadError::Refused(Box::new(points), error)),
        }
    }

    /// The forest of all points at a revision, and the sizes of their payloads.
    pub(super) fn finish(mut self, revision: u64) -> Result<(Forest, PayloadSizes), LoadError> {
        if let Some(full) = self.full {
            return Err(LoadError::Full(full));
        }
        if !self.points.is_empty() {
            self.make_room()?;
        }
        if revision > 0 {
            if let Err(error) = self.forest.apply(revision, &self.points, &[]) {
                return Err(LoadError::Refused(Box::new(self.points), error));
            }
            drop(self.points);
            let (host, space) = (&self.host, self.forest.space().clone());
            self.forest.settle_up_to(|| host.merge_rows(&space));
        }
        Ok((self.forest, self.payload_sizes))
    }
}
