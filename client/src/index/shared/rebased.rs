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
    pending: VecDeque<PendingChange>,
}

#[derive(Debug)]
struct PendingChange {
    /// The copy's change from which on searches see the write.
    visible_from: u64,
    change: Change,
}

/// A change of a published point, as the searches of own inserts see it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Difference {
    /// The tag that the searches saw.
    old_tag: Option<u64>,
    /// For searches from this change of the copy on, only the tag is new.
    tag_only_from: u64,
    /// Searches from this change of the copy on followed an own write that hides the difference.
    pub(super) hidden_from: u64,
}

impl Difference {
    /// A difference that no own write hides; `old_tag` if only the tag is new.
    pub(super) fn plain(old_tag: Option<u64>) -> Difference {
        Difference {
            old_tag,
            tag_only_from: 0,
            hidden_from: u64::MAX,
        }
    }

    /// The tag that a search at this change of the copy saw, if only the tag is new for it.
    pub(super) fn old_tag_in(&self, change: u64) -> Option<u64> {
        self.old_tag.filter(|_| change >= self.tag_only_from)
    }

    /// The point `now` in place of the point `seen`, with these own writes after either. An equal state counts as another
    /// if it `is_new`.
    fn between<'a>(
        mut seen: Option<Shown<'a>>,
        mut now: Option<Shown<'a>>,
        is_new: bool,
        mut writes: impl Iterator<Item = &'a PendingChange>,
    ) -> Difference {
        let state = |point: Option<Shown<'a>>| point.map(|(_, row)| row);
        let old_tag = seen.map(|(tag, _)| tag);
        let mut tag_only_from = match !is_new && state(seen) == state(now) {
            true => 0,
            false => u64::MAX,
        };
        let hiding = writes.find(|&write| {
            seen = write.change.apply(seen);
            now = write.change.apply(now);
            if write.change.sets_state() {
                tag_only_from = tag_only_from.min(write.visible_from);
            }
            tag_only_from != u64::MAX && seen == now
        });
        Difference {
            old_tag,
            tag_only_from,
            hidden_from: hiding.map_or(u64::MAX, |write| write.visible_from),
        }
    }
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
    /// True if the point has the state of the change after it, or none.
    fn sets_state(&self) -> bool {
        matches!(self, Change::Put(_) | Change::Replace(_) | Change::Remove)
    }

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

    /// Adds the newest write, which searches see from this change of the copy on.
    pub(super) fn push(&mut self, step: &Step<'_>, visible_from: u64) {
        let change = match *step {
            Step::Put { tag, row, .. } => Change::Put((tag, row.to_vec())),
            Step::Replace { row } => Change::Replace(row.to_vec()),
            Step::Remove => Change::Remove,
            Step::SetTag(tag) => Change::SetTag(tag),
            Step::SetPayload(_) => Change::SetPayload,
        };
        self.pending.push_back(PendingChange {
            visible_from,
            change,
        });
    }

    /// True if the published point has another tag or state than this row.
    pub(super) fn is_changed_by(&self, row: &NewRow<'_>) -> bool {
        let base = self.base.as_ref();
        base.is_some_and(|(tag, state)| *tag != row.tag || state != row.row)
    }

    /// The difference that this row makes as the published point.
    pub(super) fn difference(&self, row: &NewRow<'_>) -> Difference {
        let now = Some((row.tag, row.row));
        Difference::between(self.published(), now, row.is_new, self.pending.iter())
    }

    /// The difference between the point that the copy shows and the one that it shows once the oldest pending write is
    /// confirmed. The published point has that write already, and may have later ones of others. None if they are equal.
    pub(super) fn difference_once_confirmed(&self) -> Option<Difference> {
        let mut later = self.pending.iter();
        let now = self.published();
        let seen = later.next()?.change.apply(now);
        (seen != now).then(|| Difference::between(seen, now, false, later))
    }

    /// True if the copy may have shown another point than this one under the id, or no point.
    pub(super) fn may_have_shown_other(&self, point: Shown<'_>) -> bool {
        let mut shown = self.published();
        let mut is_other = shown != Some(point);
        for write in &self.pending {
            shown = write.change.apply(shown);
            is_other |= shown != Some(point);
        }
        is_other
    }

    /// The oldest pending write is published now. If `base` `is_newer`, it has that write already. True if no write is
    /// pending any more.
    pub(super) fn confirm(&mut self, is_newer: bool) -> bool {
        if let Some(oldest) = self.pending.pop_front()
            && !is_newer
        {
            let confirmed = oldest.change.apply(self.published());
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
        let writes = self.pending.iter();
        writes.fold(self.published(), |point, write| write.change.apply(point))
    }
}
