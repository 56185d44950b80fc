//! Reads all points into a forest.

use wayfold_index::{Forest, ForestOptions, PointRef, Points};

use crate::{Error, IndexHandle};

const CALL: &str = "replica";

/// A forest of all points of an index, at one revision and with every merge done.
pub(super) async fn load(index: &IndexHandle) -> Result<Forest, Error> {
    let mut scan = index.scan().await?;
    let (revision, total) = (scan.revision().number, scan.point_count());
    let mut points = Points::new(index.coordinates());
    while let Some(part) = scan.next().await? {
        for point in part.iter() {
            points.push_point(PointRef {
                id: point.id,
                tag: point.tag,
                revision: point.revision,
                row: point.state,
            });
        }
    }
    if points.len() as u64 != total {
        return Err(protocol(format!(
            "a scan of {} points that announced {total}",
            points.len()
        )));
    }
    let mut forest = Forest::new(
        index.space().clone(),
        ForestOptions::for_space(index.space()),
    );
    let built = tokio::task::spawn_blocking(move || {
        if revision > 0 {
            forest
                .apply(revision, &points, &[])
                .map_err(|error| protocol(error.to_string()))?;
            drop(points);
            forest.settle();
        }
        Ok(forest)
    });
    built
        .await
        .map_err(|error| protocol(format!("its points could not be built: {error}")))?
}

pub(super) fn protocol(problem: String) -> Error {
    Error::Protocol {
        call: CALL,
        problem,
    }
}
