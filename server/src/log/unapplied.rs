//! The records that an engine has taken as a journal and has yet to apply as a point store.

use std::{collections::VecDeque, sync::Arc};

use super::Record;

/// The submitted records of an index that are not yet applied, oldest first, each with the points as it left them.
pub(super) struct UnappliedQueue<Points>(VecDeque<(Arc<Record>, Points)>);

impl<Points> Default for UnappliedQueue<Points> {
    fn default() -> Self {
        Self(VecDeque::new())
    }
}

impl<Points> UnappliedQueue<Points> {
    pub(super) fn push(&mut self, record: Arc<Record>, points: Points) {
        self.0.push_back((record, points));
    }

    /// The points as of the last of `records` if that record was submitted here; all of `records` then count as
    /// applied.
    pub(super) fn apply(&mut self, records: &[Arc<Record>]) -> Option<Points> {
        let last = records.last()?.revision();
        let is_applied = |(record, _): &mut (Arc<Record>, Points)| record.revision() <= last;
        while let Some((record, points)) = self.0.pop_front_if(is_applied) {
            if record.revision() == last {
                return Some(points);
            }
        }
        None
    }

    /// The records after `after` up to `last`; None if the first of them is already applied.
    pub(super) fn between(&self, after: u64, last: u64) -> Option<Vec<Arc<Record>>> {
        let (first, _) = self.0.front()?;
        let skipped = (after + 1).checked_sub(first.revision())?;
        let records = self.0.iter().skip(skipped as usize);
        let records = records.map(|(record, _)| record);
        let records = records.take_while(|record| record.revision() <= last);
        Some(records.cloned().collect())
    }
}
