//! Merges of levels: the forest's owner begins and finishes one, and any thread runs it.

use std::{sync::Arc, time::Instant};

use super::{level::Level, packed::Packed};
use crate::{Points, Space};

/// A merge to run: it copies levels into one, without their dead points.
#[derive(Debug)]
pub struct Merge {
    pub(super) token: u64,
    pub(super) space: Arc<Space>,
    pub(super) leaf_rows: usize,
    /// Points that die later are marked dead when the merge is finished.
    pub(super) revision: u64,
    pub(super) sources: Vec<Arc<Level>>,
}

/// The result of a merge, for [`Forest::finish_merge`](super::Forest::finish_merge).
#[derive(Debug)]
pub struct Merged {
    pub(super) token: u64,
    /// None if no point was alive.
    pub(super) level: Option<Level>,
}

/// The levels that a merge has replaced, which live until this value is dropped.
#[derive(Debug, Default)]
pub struct ReplacedLevels {
    pub(super) _sources: Vec<Arc<Level>>,
}

impl Merge {
    /// The number of points stored in its levels, dead ones included.
    pub fn rows(&self) -> usize {
        self.sources.iter().map(|level| level.rows()).sum()
    }

    /// Builds the merged level, in O(d · n · log n).
    pub fn run(self) -> Merged {
        let mut points = Points::with_capacity(self.space.coordinates(), self.rows());
        for source in &self.sources {
            for slot in (0..source.rows()).filter(|&slot| source.is_visible(slot, self.revision)) {
                source.copy_to(slot, &mut points);
            }
        }
        let level = (!points.is_empty()).then(|| {
            let packed = Packed::built(self.space, &points, self.leaf_rows);
            Level::Packed(Box::new(packed), Instant::now())
        });
        Merged {
            token: self.token,
            level,
        }
    }
}

/// A merge that has begun and not finished.
#[derive(Debug)]
pub(super) struct Running {
    pub(super) token: u64,
    /// The revision at which it began.
    pub(super) revision: u64,
    pub(super) sources: Vec<Arc<Level>>,
    /// The ids of the points of its sources that died since, and the revisions that removed them.
    pub(super) died: Vec<(u64, u64)>,
}

impl Running {
    pub(super) fn has(&self, level: &Arc<Level>) -> bool {
        self.sources.iter().any(|source| Arc::ptr_eq(source, level))
    }
}
