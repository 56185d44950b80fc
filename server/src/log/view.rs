//! The points of an index as of one revision.

use std::sync::Arc;

use bytes::Bytes;
use wayfold_index::PointRef;

use super::{LogError, RecordPosition, Sessions};

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
