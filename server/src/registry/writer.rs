//! The single writer of an index. Mutations are evaluated against its state.

use std::{collections::VecDeque, sync::Arc};

use tokio::sync::OwnedMutexGuard;
use wayfold_index::{Overlay, Point, Space};

use super::Published;
use crate::log::{Operation, Record, RecordPosition, Sessions};

/// Exclusive access to an index's writer.
pub type WriteGuard = OwnedMutexGuard<Writer>;

/// The published state of an index and, over it, the records that were submitted and are not yet published.
pub struct Writer {
    space: Arc<Space>,
    base: Arc<Published>,
    /// Consecutive records after `base`.
    pending: VecDeque<Pending>,
    /// The changes of the pending records, for searches; the older ones first. An overlay is dropped once all its records
    /// are published, so a record is indexed once.
    overlays: [PendingOverlay; 2],
    /// The count of refusals at which the pending records were submitted.
    refusals: u64,
    /// The newest published revision that may have done more than add points.
    last_change: u64,
}

struct Pending {
    record: Arc<Record>,
    /// The least id above every id that was ever stored or reserved, by this record or an earlier one.
    next_id: u64,
    /// The writer sessions after this record.
    sessions: Sessions,
    /// The number of points after this record.
    points: usize,
}

/// The changes of some pending records, up to the revision `last`, which is 0 if there are none.
struct PendingOverlay {
    overlay: Overlay,
    last: u64,
}

impl PendingOverlay {
    fn empty(space: &Arc<Space>) -> Self {
        Self {
            overlay: Overlay::new(Arc::clone(space)),
            last: 0,
        }
    }
}

impl Writer {
    /// A writer over `base`.
    pub(super) fn new(space: &Arc<Space>, base: Arc<Published>) -> Self {
        Self {
            space: Arc::clone(space),
            last_change: base.revision,
            base,
            pending: VecDeque::new(),
            overlays: [PendingOverlay::empty(space), PendingOverlay::empty(space)],
            refusals: 0,
        }
    }

    /// The space of the states.
    pub fn space(&self) -> &Arc<Space> {
        &self.space
    }

    /// The published state below the pending records.
    pub fn base(&self) -> &Arc<Published> {
        &self.base
    }

    /// The newest record, pending ones included.
    pub fn position(&self) -> RecordPosition {
        let last = self.pending.back();
        last.map_or_else(|| self.base.view.position(), |last| last.record.position())
    }

    /// The revision of the newest record, pending ones included.
    pub fn revision(&self) -> u64 {
        self.position().revision
    }

    /// The writer sessions.
    pub fn sessions(&self) -> &Sessions {
        let last = self.pending.back();
        last.map_or_else(|| self.base.view.sessions(), |last| &last.sessions)
    }

    /// The least id above every id that was ever stored or reserved.
    pub fn next_id(&self) -> u64 {
        let last = self.pending.back();
        last.map_or_else(|| self.base.view.next_id(), |last| last.next_id)
    }

    /// The number of points.
    pub fn points(&self) -> usize {
        let last = self.pending.back();
        last.map_or_else(|| self.base.snapshot.len(), |last| last.points)
    }

    /// The pending records.
    pub fn pending(&self) -> impl DoubleEndedIterator<Item = &Arc<Record>> {
        self.pending.iter().map(|pending| &pending.record)
    }

    /// The count of refusals at which the pending records were submitted.
    pub(crate) fn refusals(&self) -> u64 {
        self.refusals
    }

    /// The pending operation with this id.
    pub(super) fn pending_operation(&self, id: &str) -> Option<&Arc<Operation>> {
        let operations = self
            .pending()
            .filter_map(|record| record.effects().operation());
        operations.rev().find(|operation| operation.id == id)
    }

    /// True if every point of that revision is unchanged, and every other point is newer.
    pub fn only_added_since(&self, revision: u64) -> bool {
        let is_add =
            |record: &Arc<Record>| record.revision() <= revision || record.effects().only_adds();
        self.last_change <= revision && self.pending().all(is_add)
    }

    /// Shows the changes of all pending records in [`Writer::overlays`] and [`Writer::get`].
    pub fn index_pending(&mut self) {
        let [older, newer] = &mut self.overlays;
        let indexed = older.last.max(newer.last);
        for Pending { record, .. } in &self.pending {
            if record.revision() <= indexed {
                continue;
            }
            let effects = record.effects();
            newer
                .overlay
                .apply(effects.stored(), effects.removed())
                .expect("a record's rows are checked before it is submitted");
            newer.last = record.revision();
        }
    }

    /// Prepares the changes of the pending records for many searches.
    pub fn settle_pending(&mut self) {
        for overlay in &mut self.overlays {
            overlay.overlay.settle();
        }
    }

    /// The changes of the pending records, the oldest first; complete after [`Writer::index_pending`].
    pub fn overlays(&self) -> [&Overlay; 2] {
        let [older, newer] = &self.overlays;
        [&older.overlay, &newer.overlay]
    }

    /// The point with this id, as the pending records leave it; complete after [`Writer::index_pending`].
    pub fn get(&self, id: u64) -> Option<Point> {
        let mut overlays = self.overlays().into_iter().rev();
        let changed = overlays.find_map(|overlay| overlay.get(id));
        changed.unwrap_or_else(|| self.base.snapshot.get(id))
    }

    /// Adds a record that was submitted.
    pub(super) fn push(&mut self, record: Arc<Record>) {
        let effects = record.effects();
        let removed = effects.removed().len();
        let mut sessions = self.sessions().clone();
        sessions.apply(&record);
        self.pending.push_back(Pending {
            next_id: self.next_id().max(effects.next_id()),
            sessions,
            points: self.points() + effects.inserted() - removed,
            record,
        });
    }

    /// Takes back the last record, which the journal did not take.
    pub(super) fn take_back(&mut self) {
        self.pending.pop_back();
    }

    /// Moves to a newer published state. If records were refused since, none is pending any more.
    pub(super) fn catch_up(&mut self, base: Arc<Published>, last_change: u64, refusals: u64) {
        if self.refusals != refusals {
            self.pending.clear();
        }
        while let Some(oldest) = self.pending.front()
            && oldest.record.revision() <= base.revision
        {
            self.pending.pop_front();
        }
        let [older, newer] = &mut self.overlays;
        let is_published = |overlay: &PendingOverlay| overlay.last <= base.revision;
        if self.refusals != refusals || (is_published(older) && is_published(newer)) {
            self.overlays = [
                PendingOverlay::empty(&self.space),
                PendingOverlay::empty(&self.space),
            ];
        } else if is_published(older) {
            std::mem::swap(older, newer);
            *newer = PendingOverlay::empty(&self.space);
        }
        (self.base, self.last_change, self.refusals) = (base, last_change, refusals);
    }
}
