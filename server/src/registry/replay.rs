//! Replay: builds a hosted index from the log at a restart.

use std::sync::Arc;

use tracing::{error, info};
use wayfold_index::{ApplyError, Forest, Points, PointsError};

use super::{
    Host, Hosted, IndexState, PayloadSizes, RegistryError,
    loading::{LoadError, Loader, loaded_bytes},
};
use crate::log::{Entry, LogError, StoredPoint};

/// Replay logs its progress once per this many points.
const PROGRESS_POINTS: usize = 1_000_000;

/// Replays the index of an entry. A failed replay marks it as damaged, and one for which there is not enough memory as
/// not loaded.
pub(super) fn replay_or_damaged(host: &Arc<Host>, entry: &Entry) -> IndexState {
    match replay(host, entry) {
        Ok(hosted) => IndexState::Hosted(hosted),
        Err(error) => {
            // A stop during the start closes the log.
            if !matches!(error, RegistryError::Log(LogError::Closed)) {
                error!(index = entry.name, uid = %entry.uid, %error, "cannot replay an index");
            }
            IndexState::Damaged(entry.uid, error)
        }
    }
}

/// Builds an index from its points and from the operations that the log remembers. The log of a single server
/// does not remember a call that changed nothing: the server evaluates its retry as a new call.
fn replay(host: &Arc<Host>, entry: &Entry) -> Result<Arc<Hosted>, RegistryError> {
    let mut stored = StoredPoints::new(host, entry);
    let view = host
        .log
        .points
        .load(entry.uid, &mut |point| stored.push(point))?;
    let revision = view.revision();
    let points = stored.loader.len;
    let loaded = stored.finish(revision)?;
    let operations = host.log.points.operations(entry.uid)?;
    info!(
        index = entry.name,
        uid = %entry.uid,
        revision,
        points,
        "replayed an index"
    );
    Ok(Hosted::new(host, entry, loaded, view, operations))
}

/// The points of an index while they are read.
struct StoredPoints<'a> {
    entry: &'a Entry,
    loader: Loader,
    last: Option<u64>,
}

impl<'a> StoredPoints<'a> {
    fn new(host: &Arc<Host>, entry: &'a Entry) -> Self {
        Self {
            entry,
            loader: Loader::new(host, &entry.space),
            last: None,
        }
    }

    fn push(&mut self, point: &StoredPoint) -> Result<(), LogError> {
        let entry = self.entry;
        if point.state.len() != entry.space.coordinates() {
            let what = "its state has not the width of the space";
            return Err(LogError::damaged_point(entry.uid, point.id, what));
        }
        if self.last.is_some_and(|last| last >= point.id) {
            let what = "it is stored twice";
            return Err(LogError::damaged_point(entry.uid, point.id, what));
        }
        self.last = Some(point.id);
        match self.loader.push(point) {
            // The rest of the points are counted: the index is loaded once there is memory for all.
            Ok(()) | Err(LoadError::Full(_)) => {}
            Err(LoadError::Refused(points, error)) => {
                return Err(damaged(entry, point.modified, &points, &error));
            }
        }
        let points = self.loader.len;
        if points.is_multiple_of(PROGRESS_POINTS) {
            info!(index = entry.name, points, "reading points");
        }
        Ok(())
    }

    fn finish(self, revision: u64) -> Result<(Forest, PayloadSizes), RegistryError> {
        let points = self.loader.len;
        let sizes = self.loader.payload_sizes.memory_bytes();
        self.loader.finish(revision).map_err(|error| match error {
            LoadError::Full(full) => RegistryError::NotLoaded {
                points,
                needed: loaded_bytes(&self.entry.space, points) + sizes,
                full,
            },
            LoadError::Refused(points, error) => {
                damaged(self.entry, revision, &points, &error).into()
            }
        })
    }
}

/// The error of stored points that the forest refuses: they differ from the written ones.
fn damaged(entry: &Entry, revision: u64, points: &Points, error: &ApplyError) -> LogError {
    let uid = entry.uid;
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
