//! Pending writes on a point that others may change too.
//!
//! The copy shows the published points with the pending writes after them. An insert under a new id changes a point
//! that no other writer can change, so the copy holds it like any other. For other writes the copy also keeps the
//! published point under the id, and applies the pending writes again when that changes.

use std::collections::VecDeque;

use super::batch::Step;
use crate::index::local::NewRow;

/// The content of a point: its tag and its row.
pub(super) type Content = (u64, Vec<f64>);

/// The content that an id shows, borrowed: a copy for each of thousands of pending writes would delay searches.
type Shown<'a> = (u64, &'a [f64]);

/// One id with pending writes.
#[derive(Debug)]
pub(super) struct RebasedPoint {
    /// The published point.
    pub(super) base: Option<Content>,
    /// The pending writes, the oldest first.
    pending: VecDeque<Change>,
}

#[derive(Debug)]
enum Change {
    Put(Content),
    Replace(Vec<f64>),
    Remove,
    SetTag(u64),
    /// The copy holds no payloads.
    SetPayload,
}

impl Change {
    /// Applies the change to a point.
    fn apply<'a>(&'a self, point: Option<Shown<'a>>) -> Option<Shown<'a>> {
        match self {
            Change::Put((tag, row)) => Some((*tag, row)),
            Change::Replace(row) => point.map(|(tag, _)| (tag, &row[..])),
            Change::Remove => None,
            Change::SetTag(tag) => point.map(|(_, row)| (*tag, row)),
            Change::SetPayload => point,
        }
    }
}

impl RebasedPoint {
    pub(super) fn new(base: Option<Content>) -> RebasedPoint {
        RebasedPoint {
            base,
            pending: VecDeque::new(),
        }
    }

    pub(super) fn push(&mut self, step: &Step<'_>) {
        self.pending.push_back(match *step {
            Step::Put { tag, row, .. } => Change::Put((tag, row.to_vec())),
            Step::Replace { row } => Change::Replace(row.to_vec()),
            Step::Remove => Change::Remove,
            Step::SetTag(tag) => Change::SetTag(tag),
            Step::SetPayload(_) => Change::SetPayload,
        });
    }

    /// True if the published point has another tag or state than this row.
    pub(super) fn is_changed_by(&self, row: &NewRow<'_>) -> bool {
        let base = self.base.as_ref();
        base.is_some_and(|(tag, state)| *tag != row.tag || state != row.row)
    }

    /// The oldest pending write is published now. If `base` `is_newer`, it has that write already. True if no write is
    /// pending any more.
    pub(super) fn confirm(&mut self, is_newer: bool) -> bool {
        if let Some(change) = self.pending.pop_front()
            && !is_newer
        {
            let confirmed = change.apply(self.published());
            self.base = confirmed.map(|(tag, row)| (tag, row.to_vec()));
        }
        self.pending.is_empty()
    }

    /// Gives up the newest pending write. True if no write is pending any more.
    pub(super) fn give_up(&mut self) -> bool {
        self.pending.pop_back();
        self.pending.is_empty()
    }

    fn published(&self) -> Option<Shown<'_>> {
        self.base.as_ref().map(|(tag, row)| (*tag, &row[..]))
    }

    /// The point that the copy shows.
    pub(super) fn shown(&self) -> Option<Shown<'_>> {
        let changes = self.pending.iter();
        changes.fold(self.published(), |point, change| change.apply(point))
    }
}
