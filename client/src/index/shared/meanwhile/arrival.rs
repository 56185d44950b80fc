//! The points that others stored while searches were open, one by one or in a copy that was read again.

use wayfold_index::ForestSnapshot;

use super::{MAX_ARRIVALS, open_search::OpenSearch};
use crate::index::shared::rebased::Difference;

/// The parts of one of the `k` places of an answer.
pub(super) const WHOLE_PLACE: usize = 16;

/// A point that another writer stored.
#[derive(Clone, Copy, Debug)]
pub(super) struct Arrival {
    pub(super) change: u64,
    pub(super) id: u64,
    pub(super) difference: Difference,
    /// The revision of its state, if the copy was read again; 0 if that is not known.
    pub(super) revision: Option<u64>,
}

impl Arrival {
    /// True if the answer of the search is the same with and without it, because of own writes before the search.
    pub(super) fn is_hidden(&self, open: &OpenSearch) -> bool {
        open.change >= self.difference.hidden_from
    }

    /// True if the answer of the search could not see it, and it came before the point of the search. (If the copy was read
    /// again, it may have come after.)
    pub(super) fn is_unseen(&self, open: &OpenSearch) -> bool {
        let may_be_before = match self.revision {
            Some(stored) => open.revision.is_none_or(|own| stored <= own),
            // The feed brings points that are newer than the copy.
            None => open.is_newest() || self.change < open.last_reload,
        };
        self.change > open.change && may_be_before && !self.is_hidden(open)
    }

    /// True if the search saw another state under its id, or none.
    pub(super) fn is_new(&self, open: &OpenSearch) -> bool {
        self.difference.old_tag_in(open.change).is_none()
    }

    /// The parts of a place that it takes: all if it certainly came before the point of the search, none if it may have
    /// come after.
    pub(super) fn place(&self, open: &OpenSearch) -> usize {
        let is_new = self.is_new(open);
        match self.revision {
            _ if open.is_newest() => WHOLE_PLACE,
            None if self.change < open.first_reload => WHOLE_PLACE,
            Some(1..) if open.revision.is_some() && is_new => match open.filter.tag_mask {
                0 => WHOLE_PLACE,
                // Only its state certainly came before: its tag may have passed the filter later. If it took nothing, the
                // answers after a long outage would grow until most of them are dropped.
                _ => 1,
            },
            _ => 0,
        }
    }
}

/// The changes of a copy that was read again; of each kind a few more than [`MAX_ARRIVALS`] at most.
#[derive(Debug, Default)]
pub(in crate::index::shared) struct Reloaded {
    /// The points with another state or tag: the id, the revision of the state, and the tag before if only that is new.
    pub(super) stored: Vec<(u64, u64, Option<u64>)>,
    /// The points that have left, have moved, or have another tag.
    pub(in crate::index::shared) departed: Vec<u64>,
}

impl Reloaded {
    /// The changes from `old` to `new`, whose states have these revisions, in the order of their ids.
    pub(in crate::index::shared) fn between(
        old: &ForestSnapshot,
        new: &ForestSnapshot,
        revisions: &[u64],
    ) -> Reloaded {
        let mut changes = Reloaded::default();
        let mut before = old.points_after(None).peekable();
        for (point, &revision) in new.points_after(None).zip(revisions) {
            while let Some(gone) = before.next_if(|old| old.id < point.id) {
                changes.depart(gone.id);
            }
            let known = before.next_if(|old| old.id == point.id);
            let unmoved = known.as_ref().filter(|old| old.row == point.row);
            let old_tag = unmoved.map(|old| old.tag);
            if old_tag != Some(point.tag) {
                if known.is_some() {
                    changes.depart(point.id);
                }
                if changes.stored.len() <= MAX_ARRIVALS {
                    changes.stored.push((point.id, revision, old_tag));
                }
            }
        }
        before.for_each(|gone| changes.depart(gone.id));
        changes
    }

    fn depart(&mut self, id: u64) {
        if self.departed.len() <= MAX_ARRIVALS {
            self.departed.push(id);
        }
    }
}
