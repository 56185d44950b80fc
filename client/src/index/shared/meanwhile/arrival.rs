//! The points that others stored while searches were open, one by one or in a copy that was read again.

use wayfold_index::ForestSnapshot;

use super::{AFTER_ALL, OpenSearch};

/// A point that another writer stored.
#[derive(Clone, Copy, Debug)]
pub(super) struct Arrival {
    pub(super) change: u64,
    pub(super) id: u64,
    /// Its tag before, if only the tag is new.
    pub(super) old_tag: Option<u64>,
    /// The revision of its state, if the copy was read again.
    pub(super) revision: Option<u64>,
}

impl Arrival {
    /// True if the answer of the search could not see it, and it came before the point of the search. (If the copy was read
    /// again, it may have come after.)
    pub(super) fn is_unseen(&self, open: &OpenSearch) -> bool {
        let orders = self.revision.zip(open.revision);
        self.change > open.change && orders.is_none_or(|(stored, own)| stored <= own)
    }

    /// True if it certainly came before the point of the search.
    pub(super) fn is_before(&self, open: &OpenSearch) -> bool {
        let is_state = self.revision.is_none() || self.old_tag.is_none();
        open.revision == Some(AFTER_ALL) || is_state && open.revision.is_some()
    }
}

/// The changes of a copy that was read again.
#[derive(Debug, Default)]
pub(in crate::index::shared) struct Reloaded {
    /// The points with another state or tag: the id, the revision of the state, and the tag before if only that is new.
    pub(super) stored: Vec<(u64, u64, Option<u64>)>,
    /// True if a point has left, has moved, or has another tag.
    pub(super) has_departures: bool,
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
            while before.next_if(|old| old.id < point.id).is_some() {
                changes.has_departures = true;
            }
            let known = before.next_if(|old| old.id == point.id);
            let unmoved = known.as_ref().filter(|old| old.row == point.row);
            let old_tag = unmoved.map(|old| old.tag);
            if old_tag != Some(point.tag) {
                changes.has_departures |= known.is_some();
                changes.stored.push((point.id, revision, old_tag));
            }
        }
        changes.has_departures |= before.next().is_some();
        changes
    }
}
