//! Replay: builds a hosted index from the log at a restart.

use std::sync::Arc;

use tracing::{error, info};
use wayfold_index::{ApplyError, Forest, Points, PointsError};

use super::{
    Host, Hosted, IndexState, RegistryError,
    loading::{LoadError, Loader, loaded_bytes},
    operations::Operations,
    payload_sizes::PayloadSizes,
};
use crate::{
    log::{Entry, LogError, StoredPoint},
    watermark::WatermarkExceeded,
};

/// Replay logs its progress once per this many points.
const PROGRESS_POINTS: usize = 1_000_000;

/// Replays the index of an entry. A failed replay marks it as damaged, and one for which there is not enough memory as
/// not loaded.
pub(super) fn replay_or_damaged(host: &Arc<Host>, entry: &Entry) -> IndexState {
    match replay(host, entry) {
        Ok(hosted) => IndexState::Hosted(hosted),
        Err(error) => {
            error!(index = entry.name, uid = %entry.uid, %error, "cannot replay an index");
            IndexState::Damaged(entry.uid, error)
        }
    }
}

/// Builds an index from its points and from the operations that the log remembers. The log does not remember a call
/// that changed nothing: the server evaluates its retry as a new call, with the same outcome.
fn replay(host: &Arc<Host>, entry: &Entry) -> Result<Arc<Hosted>, RegistryError> {
    let mut stored = StoredPoints::new(host, entry);
    let view = host
        .log
        .points
        .load(entry.uid, &mut |point| stored.push(point))?;
    let (forest, sizes) = stored.finish(view.revision())?;
    let mut operations = Operations::new(host.options.operations);
    for operation in host.log.points.operations(entry.uid)? {
        operations.remember(operation);
    }
    info!(
        index = entry.name,
        uid = %entry.uid,
        revision = view.revision(),
        points = forest.len(),
        "replayed an index"
    );
    Ok(Hosted::new(host, entry, (forest, sizes), view, operations))
}

/// The points of an index while they are read.
struct StoredPoints<'a> {
    entry: &'a Entry,
    /// Their forest, until memory runs out: the rest of the points are only counted.
    loader: Result<Loader, WatermarkExceeded>,
    payload_sizes: PayloadSizes,
    count: usize,
    last: Option<u64>,
}

impl<'a> StoredPoints<'a> {
    fn new(host: &Arc<Host>, entry: &'a Entry) -> Self {
        Self {
            entry,
            loader: Ok(Loader::new(host, &entry.space)),
            payload_sizes: PayloadSizes::new(host.options.counts_payloads),
            count: 0,
            last: None,
        }
    }

    fn push(&mut self, point: &StoredPoint) -> Result<(), LogError> {
        let entry = self.entry;
        if point.state.len() != entry.space.coordinates() {
            return Err(LogError::Damaged {
                uid: entry.uid,
                revision: point.modified,
                what: "a state has not the width of the space",
            });
        }
        if self.last.is_some_and(|last| last >= point.id) {
            return Err(LogError::DamagedPoint {
                uid: entry.uid,
                id: point.id,
                what: "it is stored twice",
            });
        }
        self.last = Some(point.id);
        self.count += 1;
        self.payload_sizes.set(point.id, point.payload.len());
        if let Ok(loader) = &mut self.loader {
            match loader.push(point.indexed()) {
                Ok(()) => {}
                // The loader is dropped, and the memory of its points is free for other indices.
                Err(LoadError::Full(full)) => self.loader = Err(full),
                Err(LoadError::Refused(points, error)) => {
                    return Err(damaged(entry, point.modified, &points, &error));
                }
            }
        }
        if self.count.is_multiple_of(PROGRESS_POINTS) {
            info!(index = entry.name, points = self.count, "reading points");
        }
        Ok(())
    }

    fn finish(self, revision: u64) -> Result<(Forest, PayloadSizes), RegistryError> {
        let points = self.count;
        let forest = match self.loader {
            Ok(loader) => loader.finish(revision),
            Err(full) => Err(LoadError::Full(full)),
        };
        let forest = forest.map_err(|error| match error {
            LoadError::Full(full) => RegistryError::NotLoaded {
                points,
                needed: loaded_bytes(&self.entry.space, points) + self.payload_sizes.memory_bytes(),
                full,
            },
            LoadError::Refused(points, error) => {
                damaged(self.entry, revision, &points, &error).into()
            }
        })?;
        Ok((forest, self.payload_sizes))
    }
}

/// The error of stored points that the forest refuses: they differ from the written ones.
fn damaged(entry: &Entry, revision: u64, points: &Points, error: &ApplyError) -> LogError {
    let uid = entry.uid;
    match *error {
        ApplyError::Points(PointsError::State { row, .. }) => LogError::DamagedPoint {
            uid,
            id: points.id(row),
            what: "its state is not a canonical state of the space",
        },
        ApplyError::Points(PointsError::DuplicateId(id)) => LogError::DamagedPoint {
            uid,
            id,
            what: "it is stored twice",
        },
        ApplyError::Points(PointsError::Width { .. } | PointsError::TooMany(_))
        | ApplyError::Revision { .. } => LogError::Damaged {
            uid,
            revision,
            what: "its points do not make a forest",
        },
    }
}
