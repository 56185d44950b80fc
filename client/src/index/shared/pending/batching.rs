//! The division of pending writes into batches.

use wayfold_proto::v1;

use super::{Batch, OpenSearch, PendingWrites, Step};
use crate::Limits;

/// The most steps of a batch: each waits for the slowest.
const MAX_BATCH_STEPS: usize = 4_096;

/// The bytes of a stored point apart from its payload: the state has up to 2 KiB.
const POINT_BYTES: usize = 4 << 10;

/// The steps of a batch that is worth a call.
pub(super) const LARGE_BATCH_STEPS: usize = 64;

/// The most bytes of a batch.
const MAX_BATCH_BYTES: usize = 1 << 20;

impl PendingWrites {
    /// Adds a write.
    pub(super) fn push(&mut self, id: u64, step: &Step<'_>) -> &mut Batch {
        self.bytes += Batch::step_bytes(step);
        self.written += 1;
        self.place(id, step)
    }

    /// Adds a step to the last batch, or to a new one if that is full or under way, or stores the point that the step
    /// removes.
    fn place(&mut self, id: u64, step: &Step<'_>) -> &mut Batch {
        let bytes = Batch::step_bytes(step);
        let max_steps = MAX_BATCH_STEPS.min(self.limits.max_rows_per_call).max(1);
        let max_bytes = MAX_BATCH_BYTES.min(self.limits.max_request_bytes / 2);
        let max_updates = self.max_updates();
        let is_full = self.queue.back().is_none_or(|batch| {
            batch.number != 0
                || batch.len() >= max_steps
                || (batch.update_count >= max_updates && Batch::is_update(step))
                || batch.bytes() + bytes > max_bytes
                // The server would not count the id as used, and could reserve it for another point.
                || (matches!(step, Step::Remove) && batch.chosen_ids.contains(&id))
        });
        if is_full {
            self.queue.push_back(Batch::default());
        }
        let last = self.queue.len() - 1;
        let batch = &mut self.queue[last];
        batch.push(id, step);
        batch
    }

    /// Notes the limits of the server. If a batch may have less than before, those that were never sent are divided again:
    /// the server would refuse the larger ones for good.
    pub(in crate::index::shared) fn set_limits(&mut self, limits: Limits) {
        let is_lower = limits.max_rows_per_call < self.limits.max_rows_per_call
            || limits.max_request_bytes < self.limits.max_request_bytes;
        let max_updates = self.max_updates();
        self.limits = limits;
        if is_lower || self.max_updates() < max_updates {
            self.divide_again();
        }
    }

    /// The most steps of a batch that set tags or payloads, at least one: the server refuses a batch for good if the points of
    /// these steps have too many bytes.
    pub(super) fn max_updates(&self) -> usize {
        let most = self.limits.max_changed_point_bytes;
        let point_bytes = POINT_BYTES.checked_add(self.limits.max_payload_bytes);
        point_bytes.map_or(most, |bytes| most / bytes).max(1)
    }

    fn divide_again(&mut self) {
        let is_sent = |batch: &&Batch| batch.number != 0;
        let sent = self.queue.iter().take_while(is_sent).count();
        let (width, rebased_bytes) = (self.width, self.rebased_step_bytes());
        for mut old in self.queue.split_off(sent) {
            self.bytes -= old.kept_bytes;
            let mut searches = std::mem::take(&mut old.searches).into_iter().peekable();
            for (position, (id, step)) in old.steps(width).enumerate() {
                let search = searches.next_if(|open| open.step == position);
                let mut kept = search.as_ref().map_or(0, OpenSearch::bytes);
                if self.rebased.contains_key(&id) {
                    kept += rebased_bytes;
                }
                let batch = self.place(id, &step);
                match step {
                    Step::Put { .. } if old.chosen_ids.contains(&id) => batch.chosen_ids.push(id),
                    Step::Put { .. } => batch.assign(id),
                    _ => {}
                }
                if let Some(mut open) = search {
                    open.step = batch.len() - 1;
                    batch.searches.push(open);
                }
                batch.kept_bytes += kept;
                self.bytes += kept;
            }
        }
    }

    /// The next batch to send, which grows no more. With `reserve_count` there is one even if no write is pending.
    pub(in crate::index::shared) fn next(
        &mut self,
        session: u64,
        reserve_count: u64,
    ) -> Option<v1::WriteRequest> {
        let is_taken = |batch: &Batch| batch.revision.is_some();
        if reserve_count > 0 && self.queue.iter().all(is_taken) {
            self.queue.push_back(Batch::default());
        }
        let batch = self.queue.iter_mut().find(|batch| !is_taken(batch))?;
        if batch.number == 0 {
            batch.number = self.next_number;
            batch.session = session;
            batch.reserve_count = reserve_count;
            self.next_number += 1;
        }
        Some(batch.message())
    }

    /// True if the next batch has many writes, or grows no more.
    pub(in crate::index::shared) fn is_next_large(&self) -> bool {
        let mut next = self.queue.iter().filter(|batch| batch.number == 0);
        let is_large = |batch: &Batch| batch.len() >= LARGE_BATCH_STEPS;
        next.next().is_some_and(is_large) || next.next().is_some()
    }
}
