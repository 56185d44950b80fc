//! The newest records of an index, cached in memory for its subscribers.

use std::sync::Arc;

use crate::log::{BoundedQueue, Record};

/// The maximum bytes of cached records. The newest record is always cached. A subscriber further behind reads the log.
const MAX_BYTES: usize = 4 * 1024 * 1024;

/// A cache of the newest records.
pub(super) struct RecentRecords {
    /// Consecutive revisions up to the newest.
    records: BoundedQueue<Arc<Record>>,
    max_bytes: usize,
}

impl RecentRecords {
    /// A cache of at most `window_bytes`, the bytes of records that the log keeps.
    pub(super) fn new(window_bytes: usize) -> Self {
        Self {
            records: BoundedQueue::default(),
            max_bytes: window_bytes.min(MAX_BYTES),
        }
    }

    /// Adds the next record.
    pub(super) fn push(&mut self, record: Arc<Record>) {
        let bytes = record.effects().bytes();
        self.records.push(record, bytes);
        let forget = || self.records.forget(usize::MAX, self.max_bytes, |_| false);
        std::iter::from_fn(forget).for_each(drop);
    }

    /// The bytes of the cached records.
    pub(super) fn bytes(&self) -> u64 {
        self.records.window().bytes
    }

    /// The records after the revision `after` up to `last`: the first ones that fit into `max_bytes`, but at least one.
    /// None if some of them are not cached.
    pub(super) fn after(
        &self,
        after: u64,
        last: u64,
        max_bytes: usize,
    ) -> Option<Vec<Arc<Record>>> {
        let first = self.records.iter().next()?.revision();
        let skipped = after.checked_add(1)?.checked_sub(first)? as usize;
        let mut page = Vec::new();
        let mut bytes = 0;
        for record in self.records.iter().skip(skipped) {
            bytes += record.effects().bytes();
            if record.revision() > last || (bytes > max_bytes && !page.is_empty()) {
                break;
            }
            page.push(Arc::clone(record));
        }
        Some(page)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::log::Effects;

    fn revisions(recent: &RecentRecords, after: u64, last: u64, most: usize) -> Option<Vec<u64>> {
        let page = recent.after(after, last, most)?;
        Some(page.iter().map(|record| record.revision()).collect())
    }

    #[test]
    fn pages_are_consecutive_and_uncached_records_give_none() {
        let mut recent = RecentRecords::new(usize::MAX);
        assert_eq!(revisions(&recent, 0, 9, 1000), None);
        for revision in 5..=9 {
            let record = Record::new(revision, [0; 32], 0, Effects::new(1));
            recent.push(Arc::new(record));
        }
        let bytes = Effects::new(1).bytes();
        assert_eq!(revisions(&recent, 3, 9, 0), None);
        assert_eq!(revisions(&recent, 4, 9, 0), Some(vec![5]));
        assert_eq!(revisions(&recent, 4, 9, 2 * bytes), Some(vec![5, 6]));
        assert_eq!(revisions(&recent, 6, 8, usize::MAX), Some(vec![7, 8]));
        assert_eq!(revisions(&recent, 9, 9, 1000), Some(vec![]));
        assert_eq!(revisions(&recent, u64::MAX, 9, 1000), None);
    }

    #[test]
    fn the_oldest_records_go_and_the_newest_stays_at_any_size() {
        let mut recent = RecentRecords::new(usize::MAX);
        for revision in 1..=3 {
            let mut effects = Effects::new(1);
            (0..MAX_BYTES as u64 / 16 * revision).for_each(|id| effects.remove(id));
            recent.push(Arc::new(Record::new(revision, [0; 32], 0, effects)));
        }
        assert_eq!(revisions(&recent, 1, 3, usize::MAX), None);
        assert_eq!(revisions(&recent, 2, 3, 0), Some(vec![3]));
    }

    #[test]
    fn the_cache_holds_no_more_bytes_than_the_log() {
        let mut recent = RecentRecords::new(0);
        for revision in 1..=3 {
            let record = Record::new(revision, [0; 32], 0, Effects::new(1));
            recent.push(Arc::new(record));
        }
        assert_eq!(revisions(&recent, 1, 3, usize::MAX), None);
        assert_eq!(revisions(&recent, 2, 3, usize::MAX), Some(vec![3]));
    }
}
