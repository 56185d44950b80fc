//! From the log to a hosted index: what a restart does.

use std::sync::Arc;

use tracing::{error, info};
use wayfold_index::{ApplyError, PointRef, Points, PointsError};

use super::{Host, Hosted, Place, RegistryError, Writer, operations::EVERY_OPERATION};
use crate::log::{Entry, LogError, View};

/// How many points are read at a time.
const PAGE: usize = 4096;

/// After how many points a line of the log says how far it is.
const PROGRESS: usize = 250 * PAGE;

/// The index of an entry, or why it cannot be replayed.
pub(super) fn replayed(host: &Arc<Host>, entry: &Entry) -> Place {
    match replay(host, entry) {
        Ok(hosted) => Place::Hosted(hosted),
        Err(error) => {
            error!(index = entry.name, uid = %entry.uid, %error, "cannot replay an index");
            Place::Damaged(entry.uid, error)
        }
    }
}

/// Builds an index from its points, with the operations that the log remembers. A call that changed nothing left
/// none: its retry is evaluated anew, which it cannot tell from a first try.
fn replay(host: &Arc<Host>, entry: &Entry) -> Result<Arc<Hosted>, RegistryError> {
    let view = host.log.points(entry.uid)?;
    let mut forest = host.options.forest(&entry.space);
    if view.revision() > 0 {
        let points = load(&*view, entry)?;
        forest
            .apply(view.revision(), &points, &[])
            .map_err(|error| damaged(entry, view.revision(), &points, &error))?;
        forest.settle();
    }
    let mut writer = Writer::new(forest, Arc::clone(&view));
    for operation in host.log.operations(entry.uid)? {
        writer.remember(operation, EVERY_OPERATION);
    }
    info!(
        index = entry.name,
        uid = %entry.uid,
        revision = view.revision(),
        points = writer.head().snapshot.len(),
        "replayed an index"
    );
    Ok(Hosted::new(host, entry, writer))
}

/// Points of the log that the forest refuses are not those that were written.
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

fn load(view: &dyn View, entry: &Entry) -> Result<Points, LogError> {
    let mut points = Points::new(entry.space.coordinates());
    let mut after = None;
    loop {
        let page = view.page(after, PAGE)?;
        let Some(last) = page.last() else {
            return Ok(points);
        };
        after = Some(last.id);
        for point in &page {
            if point.state.len() != entry.space.coordinates() {
                return Err(LogError::Damaged {
                    uid: entry.uid,
                    revision: point.modified,
                    what: "a state has not the width of the space",
                });
            }
            points.push_point(PointRef {
                id: point.id,
                tag: point.tag,
                revision: point.revision,
                row: &point.state,
            });
        }
        if points.len() >= PROGRESS && points.len() % PROGRESS < page.len() {
            info!(index = entry.name, points = points.len(), "reading points");
        }
    }
}
