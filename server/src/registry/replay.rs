//! Replay: builds a hosted index from the log at a restart.

use std::sync::Arc;

use tracing::{error, info};
use wayfold_index::{ApplyError, Points, PointsError};

use super::{Host, Hosted, IndexState, RegistryError, operations::Operations};
use crate::log::{Entry, LogError, StoredPoint};

/// Replay logs its progress once per this many points.
const PROGRESS_POINTS: usize = 1_000_000;

/// Replays the index of an entry. A failed replay marks it as damaged.
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
    let mut points = Points::new(entry.space.coordinates());
    let mut visit = |point: &StoredPoint| push(&mut points, entry, point);
    let view = host.log.points.load(entry.uid, &mut visit)?;
    let mut forest = host.options.forest(&entry.space);
    if view.revision() > 0 {
        forest
            .apply(view.revision(), &points, &[])
            .map_err(|error| damaged(entry, view.revision(), &points, &error))?;
        forest.settle();
    }
    let mut operations = Operations::new();
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
    Ok(Hosted::new(host, entry, forest, view, operations))
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

/// Adds a stored point to those of a forest.
fn push(points: &mut Points, entry: &Entry, point: &StoredPoint) -> Result<(), LogError> {
    if point.state.len() != entry.space.coordinates() {
        return Err(LogError::Damaged {
            uid: entry.uid,
            revision: point.modified,
            what: "a state has not the width of the space",
        });
    }
    points.push_point(point.indexed());
    if points.len().is_multiple_of(PROGRESS_POINTS) {
        info!(index = entry.name, points = points.len(), "reading points");
    }
    Ok(())
}
