//! The newest changes of an index in this process.

use std::collections::VecDeque;

use wayfold_index::ReadRevision;

/// The most changes that are kept, 16 bytes each.
const MAX_CHANGES: usize = 1 << 16;

/// One change: its number, and the id that it stored or removed.
#[derive(Clone, Copy, Debug)]
struct Change {
    number: u64,
    id: u64,
}

/// The ids that changed, in the order of their changes.
#[derive(Debug, Default)]
pub(super) struct History {
    changes: VecDeque<Change>,
    /// Changes up to this one are forgotten.
    forgotten: u64,
}

impl History {
    /// Notes that change number `change` stored or removed the point with this id.
    pub(super) fn push(&mut self, change: u64, id: u64) {
        if self.changes.len() == MAX_CHANGES
            && let Some(oldest) = self.changes.pop_front()
        {
            self.forgotten = oldest.number;
        }
        self.changes.push_back(Change { number: change, id });
    }

    /// Forgets everything up to change number `change`.
    pub(super) fn forget(&mut self, change: u64) {
        self.changes = VecDeque::new();
        self.forgotten = change;
    }

    /// The ids of the changes after the revision `since`, the newest first. None if some of them are forgotten.
    pub(super) fn after(&self, since: ReadRevision) -> Option<Vec<u64>> {
        if since.0 < self.forgotten {
            return None;
        }
        let newer = self.changes.iter().rev();
        let newer = newer.take_while(|change| change.number > since.0);
        Some(newer.map(|change| change.id).collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_ids_of_newer_changes_are_named() {
        let mut history = History::default();
        for (change, id) in [(1, 7), (2, 8), (3, 7)] {
            history.push(change, id);
        }
        assert_eq!(history.after(ReadRevision(0)), Some(vec![7, 8, 7]));
        assert_eq!(history.after(ReadRevision(2)), Some(vec![7]));
        assert_eq!(history.after(ReadRevision(3)), Some(vec![]));
    }

    #[test]
    fn forgotten_changes_are_reported() {
        let mut history = History::default();
        for change in 1..=MAX_CHANGES as u64 + 2 {
            history.push(change, change);
        }
        assert_eq!(history.after(ReadRevision(1)), None);
        assert_eq!(
            history.after(ReadRevision(2)).map(|ids| ids.len()),
            Some(MAX_CHANGES)
        );
        history.forget(MAX_CHANGES as u64 + 3);
        assert_eq!(history.changes.capacity(), 0);
        assert_eq!(history.after(ReadRevision(MAX_CHANGES as u64 + 2)), None);
        assert_eq!(
            history.after(ReadRevision(MAX_CHANGES as u64 + 3)),
            Some(vec![])
        );
    }
}
