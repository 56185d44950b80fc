//! The content of an index, as read by a scan.

use std::collections::BTreeMap;

use tonic::Status;
use wayfold_proto::v1::{Revision, ScanRequest};

use crate::{INCLUDE_ALL, Stubs, bits};

/// An index at one revision; equal contents are equal in every bit.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Content {
    /// The index's uid.
    pub uid: String,
    /// The revision that was read.
    pub revision: u64,
    /// The points by id.
    pub points: BTreeMap<u64, StoredPoint>,
}

/// One point of an index.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct StoredPoint {
    /// The bits of its canonical coordinates.
    pub state: Vec<u64>,
    /// Its tag.
    pub tag: u64,
    /// The revision that stored its state.
    pub revision: u64,
    /// Its payload.
    pub payload: Vec<u8>,
}

impl Content {
    /// Reads an index from end to end.
    ///
    /// # Errors
    /// The scan's status.
    ///
    /// # Panics
    /// If the parts of the scan disagree with each other or are out of order.
    pub async fn read(stubs: &Stubs, index: &str) -> Result<Self, Status> {
        let request = ScanRequest {
            index_name: index.to_owned(),
            include: Some(INCLUDE_ALL),
            ..Default::default()
        };
        Self::read_as(stubs, request).await
    }

    /// Reads the answer to a scan of all columns.
    ///
    /// # Errors
    /// The scan's status.
    ///
    /// # Panics
    /// Panics where [`Content::read`] does.
    pub async fn read_as(stubs: &Stubs, request: ScanRequest) -> Result<Self, Status> {
        let mut parts = stubs.points.clone().scan(request).await?.into_inner();
        let mut content: Option<(Self, u64)> = None;
        let mut last_id = None;
        while let Some(part) = parts.message().await? {
            let (read, total) = content.get_or_insert_with(|| {
                let Revision { uid, number } = part.revision.clone().expect("a revision");
                let read = Self {
                    uid,
                    revision: number,
                    points: BTreeMap::new(),
                };
                (read, part.point_count)
            });
            let Revision { uid, number } = part.revision.expect("a revision");
            assert_eq!((&uid, number), (&read.uid, read.revision));
            assert_eq!(part.point_count, *total);
            let points = part.points.unwrap_or_default();
            let rows = points.states.unwrap_or_default();
            assert_eq!(rows.row_count as usize, points.ids.len());
            let coordinates = rows.coordinates.len().checked_div(points.ids.len());
            for (i, &id) in points.ids.iter().enumerate() {
                assert!(last_id < Some(id), "{id} after {last_id:?}");
                last_id = Some(id);
                let width = coordinates.expect("rows");
                let point = StoredPoint {
                    state: bits(&rows.coordinates[i * width..][..width]),
                    tag: points.tags[i],
                    revision: points.revisions[i],
                    payload: points.payloads[i].to_vec(),
                };
                read.points.insert(id, point);
            }
        }
        let (read, total) = content.expect("a scan has at least one part");
        assert_eq!(read.points.len() as u64, total);
        Ok(read)
    }
}
