//! One level of a forest.

use std::sync::Arc;

use super::{growing::Growing, packed::Packed};
use crate::{Point, Points, TreeReport, kernel::Set, search::Walk};

/// Points by ascending id.
pub(super) type InOrder<'a> = Box<dyn Iterator<Item = Point> + Send + 'a>;

/// Shared by count between the forest, its snapshots and the merges under way.
#[derive(Debug)]
pub(super) enum Level {
    /// What a merge has made, or a large mutation.
    Packed(Box<Packed>),
    /// What has grown until it was full.
    Grown(Arc<Growing>),
}

/// The same of either kind.
macro_rules! of {
    ($level:expr, $held:ident => $result:expr) => {
        match $level {
            Level::Packed($held) => $result,
            Level::Grown($held) => $result,
        }
    };
}

impl Level {
    /// How many points it stores, dead ones included.
    pub(super) fn rows(&self) -> usize {
        of!(self, held => held.rows())
    }

    /// How many of them are dead at the head.
    pub(super) fn dead(&self) -> usize {
        of!(self, held => held.dead())
    }

    /// Whether a merge has built its tree.
    pub(super) fn is_built(&self) -> bool {
        match self {
            Level::Packed(packed) => packed.is_built(),
            Level::Grown(_) => false,
        }
    }

    pub(super) fn get(&self, slot: usize) -> Point {
        of!(self, held => held.get(slot))
    }

    /// Appends a copy of the point in `slot` to `points`.
    pub(super) fn copy_to(&self, slot: usize, points: &mut Points) {
        of!(self, held => held.copy_to(slot, points));
    }

    pub(super) fn sees(&self, slot: usize, revision: u64) -> bool {
        of!(self, held => held.sees(slot, revision))
    }

    /// The slot of the point with this id, if a reader at `revision` sees it.
    pub(super) fn find(&self, id: u64, revision: u64) -> Option<usize> {
        of!(self, held => held.find(id, revision))
    }

    /// What a reader at `revision` sees of the ids above `after`, in their order.
    pub(super) fn points_after(&self, after: Option<u64>, revision: u64) -> InOrder<'_> {
        of!(self, held => held.points_after(after, revision))
    }

    /// Removes the point in `slot` as of `revision`.
    pub(super) fn bury(&self, slot: usize, revision: u64) {
        of!(self, held => held.bury(slot, revision));
    }

    /// Shows `walk` what a reader at `revision` sees.
    #[inline(always)]
    pub(super) fn visit<'a, S: Set>(&'a self, walk: &mut Walk<'a>, revision: u64) {
        of!(self, held => held.visit::<S>(walk, revision));
    }

    pub(super) fn memory_bytes(&self) -> usize {
        of!(self, held => held.memory_bytes())
    }

    pub(super) fn validate(&self) -> Result<TreeReport, String> {
        of!(self, held => held.validate())
    }
}
