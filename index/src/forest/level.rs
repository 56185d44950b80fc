//! A level of a forest.

use std::{sync::Arc, time::Instant};

use super::{growing::GrowingTree, static_level::StaticLevel};
use crate::{Point, Points, TreeReport, lanes::Isa, traversal::Traversal};

/// Points by ascending id.
pub(super) type PointsById<'a> = Box<dyn Iterator<Item = Point> + Send + 'a>;

/// One level, shared by count between the forest, its snapshots and the running merges.
#[derive(Debug)]
pub(super) enum Level {
    /// The result of a merge, or the points of a large mutation, and the time when the level was made.
    Static(Box<StaticLevel>, Instant),
    /// A growing tree that was full, and the time when it was.
    Grown(Arc<GrowingTree>, Instant),
}

/// The same expression for either kind.
macro_rules! for_either {
    ($level:expr, $held:ident => $result:expr) => {
        match $level {
            Level::Static($held, _) => $result,
            Level::Grown($held, _) => $result,
        }
    };
}

impl Level {
    /// The number of points stored, dead ones included.
    pub(super) fn rows(&self) -> usize {
        for_either!(self, held => held.rows())
    }

    /// The number of points dead at the head.
    pub(super) fn dead(&self) -> usize {
        for_either!(self, held => held.dead())
    }

    /// True if a merge has built its tree.
    pub(super) fn is_packed(&self) -> bool {
        match self {
            Level::Static(level, _) => level.is_packed(),
            Level::Grown(..) => false,
        }
    }

    /// The time since which its points wait for a merge; None if it is packed.
    pub(super) fn unpacked_since(&self) -> Option<Instant> {
        let (Level::Static(_, made) | Level::Grown(_, made)) = self;
        (!self.is_packed()).then_some(*made)
    }

    pub(super) fn get(&self, slot: usize) -> Point {
        for_either!(self, held => held.get(slot))
    }

    /// Appends a copy of the point in `slot` to `points`.
    pub(super) fn copy_to(&self, slot: usize, points: &mut Points) {
        for_either!(self, held => held.copy_to(slot, points));
    }

    pub(super) fn is_visible(&self, slot: usize, revision: u64) -> bool {
        for_either!(self, held => held.is_visible(slot, revision))
    }

    /// The slot of the point with this id, if a reader at `revision` sees it.
    pub(super) fn find(&self, id: u64, revision: u64) -> Option<usize> {
        for_either!(self, held => held.find(id, revision))
    }

    /// The points that a reader at `revision` sees above the id `after`.
    pub(super) fn points_after(&self, after: Option<u64>, revision: u64) -> PointsById<'_> {
        for_either!(self, held => held.points_after(after, revision))
    }

    /// Removes the point in `slot` as of `revision`.
    pub(super) fn mark_dead(&self, slot: usize, revision: u64) {
        for_either!(self, held => held.mark_dead(slot, revision));
    }

    /// Searches the points that a reader at `revision` sees.
    #[inline(always)]
    pub(super) fn search<'a, I: Isa>(&'a self, traversal: &mut Traversal<'a>, revision: u64) {
        for_either!(self, held => held.search::<I>(traversal, revision));
    }

    pub(super) fn memory_bytes(&self) -> usize {
        for_either!(self, held => held.memory_bytes())
    }

    pub(super) fn validate(&self) -> Result<TreeReport, String> {
        for_either!(self, held => held.validate())
    }
}
