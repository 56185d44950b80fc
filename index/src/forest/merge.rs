//! Merges of levels: the forest's owner begins and finishes one, and any thread runs it.

use std::{sync::Arc, time::Instant};

use super::{level::Level, static_level::StaticLevel};
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

/// The levels that a merge has replaced, or the level of an ignored merge. They live until this value is dropped.
#[derive(Debug)]
pub struct ReplacedLevels {
    pub(super) _levels: Vec<Arc<Level>>,
}

impl Merge {
    /// The number of points stored in its levels, dead ones included.
    pub fn rows(&self) -> usize {
        self.sources.iter().map(|level| level.rows()).sum()
    }

    /// True while its forest, or a snapshot of it, has its levels: without them the result is of no use.
    pub fn is_wanted(&self) -> bool {
        // A forest holds each of them until the merge is finished.
        self.sources
            .iter()
            .any(|source| Arc::strong_count(source) > 1)
    }

    /// Builds the merged level, in O(d · n · log n).
    pub fn run(self) -> Merged {
        let live = self.sources.iter().map(|level| level.rows() - level.dead());
        let mut points = Points::with_capacity(self.space.coordinates(), live.sum());
        for source in &self.sources {
            for slot in (0..source.rows()).filter(|&slot| source.is_visible(slot, self.revision)) {
                source.copy_to(slot, &mut points);
            }
        }
        let level = (!points.is_empty()).then(|| {
            let level = StaticLevel::packed(self.space, &points, self.leaf_rows);
            Level::Static(Box::new(level), Instant::now())
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

#[cfg(test)]
mod tests {
    use crate::{Forest, ForestOptions, Merge, Points, Space};

    /// Stores points with the ids `ids` as one mutation.
    fn store(forest: &mut Forest, ids: std::ops::Range<u64>) {
        let revision = forest.revision() + 1;
        let mut points = Points::new(1);
        ids.for_each(|id| points.push(id, 0, revision, &[id as f64]));
        forest.apply(revision, &points, &[]).unwrap();
    }

    /// A forest with an unpacked level of a large mutation and one that grew, and the merge of both.
    fn merging() -> (Forest, Merge) {
        let options = ForestOptions {
            growing_rows: 16,
            leaf_rows: 16,
        };
        let mut forest = Forest::new("R1".parse::<Space>().unwrap(), options);
        store(&mut forest, 0..10);
        (10..26).for_each(|id| store(&mut forest, id..id + 1));
        let merge = forest.begin_merge().unwrap();
        assert_eq!(merge.sources.len(), 2);
        (forest, merge)
    }

    #[test]
    fn a_merge_is_wanted_as_long_as_its_levels() {
        let (mut forest, merge) = merging();
        assert!(merge.is_wanted());
        // Later levels, a later merge and removals do not change that.
        (26..58).for_each(|id| store(&mut forest, id..id + 1));
        let later = forest.begin_merge().unwrap();
        forest.finish_merge(later.run());
        let every_id: Vec<u64> = (0..58).collect();
        let revision = forest.revision() + 1;
        forest.apply(revision, &Points::new(1), &every_id).unwrap();
        assert!(merge.is_wanted());
        let snapshot = forest.snapshot();
        drop(forest);
        assert!(merge.is_wanted());
        drop(snapshot);
        assert!(!merge.is_wanted());
    }

    #[test]
    fn the_caller_frees_the_levels_of_any_finished_merge() {
        let ((mut one, merge), (_, others)) = (merging(), merging());
        assert_eq!(one.finish_merge(others.run())._levels.len(), 1);
        assert_eq!(one.finish_merge(merge.run())._levels.len(), 2);
    }
}
