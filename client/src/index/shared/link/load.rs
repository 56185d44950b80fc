//! The points of an index as a forest.

use futures_util::{StreamExt, TryStreamExt, stream::BoxStream};
use tokio::time::{Instant, sleep_until};
use wayfold_index::{Forest, ForestOptions, PointRef, Points, Space};

use super::{Link, Transport, handle};
use crate::{Error, IndexInfo, net::limits::exceeded};

const CALL: &str = "scan";

/// The limit of the revisions that a server holds for scans.
const HELD_SCANS: &str = "max_held_scans";

/// The most scans of a load that the server may end: it holds a revision for some minutes, or until it stops.
const MAX_ENDED_SCANS: u32 = 3;

/// Points of one revision, in the order of their ids.
pub(super) struct Part {
    pub(super) points: crate::Points,
    /// The number of all points of the revision.
    pub(super) total: u64,
}

/// All points of one revision; one part at least.
pub(super) type Parts = BoxStream<'static, Result<Part, Error>>;

impl Link {
    /// All points of the index at revision `min_revision` or a later one, that revision, and those of their states, in the
    /// order of their ids. Every point counts as stored by change `change`.
    pub(in crate::index::shared) async fn load(
        &self,
        index: &IndexInfo,
        min_revision: u64,
        change: u64,
    ) -> Result<(Forest, u64, Vec<u64>), Error> {
        let (mut ended, mut refused) = (0, 0);
        let deadline = Instant::now() + self.timeout;
        let (points, revision, revisions) = loop {
            match self.read_all(index, min_revision, change).await {
                Err(error) if error.reason() == Some("SCAN_ENDED") && ended < MAX_ENDED_SCANS => {
                    ended += 1;
                }
                Err(error) if exceeded(&error) == Some(HELD_SCANS) && Instant::now() < deadline => {
                    refused += 1;
                    sleep_until(Instant::now() + self.pause(refused, None)).await;
                }
                read => break read?,
            }
        };
        let space = index.space.clone();
        let building = tokio::task::spawn_blocking(move || build(&space, points, change));
        let built = building.await;
        let forest = built.map_err(|error| {
            Error::protocol(CALL, format!("its points cannot be built: {error}"))
        })?;
        Ok((forest?, revision, revisions))
    }

    async fn read_all(
        &self,
        index: &IndexInfo,
        min_revision: u64,
        change: u64,
    ) -> Result<(Points, u64, Vec<u64>), Error> {
        let mut parts: Parts = match &self.transport {
            Transport::Grpc(client) => {
                let scan = handle(client, index, min_revision).scan().await?;
                let total = scan.point_count();
                let parts = scan.into_stream();
                parts.map_ok(move |points| Part { points, total }).boxed()
            }
            #[cfg(feature = "zenoh")]
            Transport::Zenoh(link) => link.scan(index, min_revision),
        };
        let mut points = Points::new(index.coordinate_count);
        let mut revisions = Vec::new();
        let (mut revision, mut announced) = (0, 0);
        while let Some(part) = parts.try_next().await? {
            (revision, announced) = (part.points.revision().number, part.total);
            for point in part.points.iter() {
                revisions.push(point.revision);
                points.push_point(PointRef {
                    id: point.id,
                    tag: point.tag,
                    revision: change,
                    row: point.state,
                });
            }
            if points.len() as u64 > announced {
                break;
            }
        }
        if points.len() as u64 != announced {
            let found = points.len();
            let problem = format!("a scan of {found} points that announced {announced}");
            return Err(Error::protocol(CALL, problem));
        }
        Ok((points, revision, revisions))
    }
}

/// A forest of the points, without anything left to merge.
fn build(space: &Space, points: Points, change: u64) -> Result<Forest, Error> {
    let mut forest = Forest::new(space.clone(), ForestOptions::for_space(space));
    let applied = forest.apply(change, &points, &[]);
    applied.map_err(|error| Error::protocol(CALL, error.to_string()))?;
    drop(points);
    forest.settle();
    Ok(forest)
}
