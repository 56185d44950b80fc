//! Merging levels away from the writer: begun and finished by the forest's owner, run on any thread in between.

use std::sync::Arc;

use super::{level::Level, packed::Packed};
use crate::{Points, Space};

/// A merge that is due: levels to copy into one, without their dead.
#[derive(Debug)]
pub struct Merge {
    pub(super) token: u64,
    pub(super) space: Arc<Space>,
    pub(super) leaf_rows: usize,
    /// What died later is buried again when the merge is finished.
    pub(super) revision: u64,
    pub(super) sources: Vec<Arc<Level>>,
}

/// A merge that has run; [`Forest::finish_merge`](super::Forest::finish_merge) swaps it in.
#[derive(Debug)]
pub struct Merged {
    pub(super) token: u64,
    /// None if nothing was alive.
    pub(super) level: Option<Level>,
}

impl Merge {
    /// How many points it copies at most.
    pub fn rows(&self) -> usize {
        self.sources.iter().map(|level| level.rows()).sum()
    }

    /// Builds the merged level, in O(d · n · log n).
    pub fn run(self) -> Merged {
        let mut points = Points::with_capacity(self.space.coordinates(), self.rows());
        for source in &self.sources {
            for slot in (0..source.rows()).filter(|&slot| source.sees(slot, self.revision)) {
                source.copy_to(slot, &mut points);
            }
        }
        let level = (!points.is_empty()).then(|| {
            let packed = Packed::built(self.space, points, self.leaf_rows);
            Level::Packed(Box::new(packed))
        });
        Merged {
            token: self.token,
            level,
        }
    }
}

/// What the forest remembers of a merge under way.
#[derive(Debug)]
pub(super) struct Running {
    pub(super) token: u64,
    /// At which it began.
    pub(super) revision: u64,
    pub(super) sources: Vec<Arc<Level>>,
    /// Points of the sources that died since it began, and when.
    pub(super) buried: Vec<(u64, u64)>,
}

impl Running {
    pub(super) fn has(&self, level: &Arc<Level>) -> bool {
        self.sources.iter().any(|source| Arc::ptr_eq(source, level))
    }
}
