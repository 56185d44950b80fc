//! The points of an index as of one revision.

use std::sync::Arc;

use bytes::Bytes;
use wayfold_index::PointRef;

use super::{LogError, RecordPosition, Sessions};

/// The points that [`View::page_within`] reads at once: with payloads of 64 KiB they take a megabyte.
const SMALL_PAGE_POINTS: usize = 16;

/// The points of one index as of one revision: the sum of the records up to that revision. They do not change while the
/// view is held.
pub trait View: Send + Sync {
    /// The revision.
    fn revision(&self) -> u64 {
        self.position().revision
    }

    /// The least id above every id that was ever stored or reserved, by this revision or an earlier one.
    fn next_id(&self) -> u64;

    /// The writer sessions.
    fn sessions(&self) -> &Sessions;

    /// The newest record in the sum.
    fn position(&self) -> RecordPosition;

    /// The point with this id.
    fn get(&self, id: u64) -> Result<Option<Arc<StoredPoint>>, LogError>;

    /// Up to `limit` points with ids above `after` (from the first if None), by ascending id.
    fn page(&self, after: Option<u64>, limit: usize) -> Result<Vec<Arc<StoredPoint>>, LogError>;

    /// Like [`View::page`], but the page ends with the point by which it has `max_bytes` (see [`StoredPoint::bytes`]).
    fn page_within(
        &self,
        mut after: Option<u64>,
        limit: usize,
        max_bytes: usize,
    ) -> Result<Vec<Arc<StoredPoint>>, LogError> {
        let (mut points, mut bytes) = (Vec::new(), 0);
        while points.len() < limit {
            let page = self.page(after, SMALL_PAGE_POINTS.min(limit - points.len()))?;
            let Some(last) = page.last() else {
                break;
            };
            after = Some(last.id);
            for point in page {
                bytes += point.bytes();
                points.push(point);
                if bytes >= max_bytes {
                    return Ok(points);
                }
            }
        }
        Ok(points)
    }
}

/// A point as the log stores it.
#[derive(Clone, Debug, PartialEq)]
pub struct StoredPoint {
    /// Its id.
    pub id: u64,
    /// The revision that stored its state.
    pub revision: u64,
    /// The revision that last changed its state, its tag or its payload.
    pub modified: u64,
    /// Its tag.
    pub tag: u64,
    /// Its state: a canonical row.
    pub state: Box<[f64]>,
    /// Its payload.
    pub payload: Bytes,
}

impl StoredPoint {
    /// The bytes that it takes in memory.
    pub fn bytes(&self) -> usize {
        size_of::<Self>() + size_of_val(&*self.state) + self.payload.len()
    }

    /// The part of the point that a forest holds.
    pub fn indexed(&self) -> PointRef<'_> {
        PointRef {
            id: self.id,
            tag: self.tag,
            revision: self.revision,
            row: &self.state,
        }
    }
}
