//! The part of its history that a journal keeps: the newest records, for its followers, and the newest operations, for
//! retries.

use std::{collections::VecDeque, time::SystemTime};

use super::{Record, record::time_ms};

/// A record counts as at most this much older than its arrival.
const MAX_AGE_AT_ARRIVAL_MS: u64 = 10_000;

/// The time from which a record that arrives now counts towards a window, in milliseconds since 1970. Another server may have
/// stamped it, and with its clock far behind this one's the window would keep only the newest record.
pub(super) fn arrival_ms(record: &Record) -> u64 {
    counted_ms(record.time_ms(), time_ms(SystemTime::now()))
}

/// The time from which a record with this stamp counts if it arrives at `now_ms`.
fn counted_ms(stamp_ms: u64, now_ms: u64) -> u64 {
    stamp_ms.clamp(now_ms.saturating_sub(MAX_AGE_AT_ARRIVAL_MS), now_ms)
}

/// The bounds on the records and operations of an index that are kept.
#[derive(Clone, Copy, Debug)]
pub struct Retention {
    /// The maximum bytes of records (see [`Effects::bytes`](super::Effects::bytes)).
    pub record_bytes: usize,
    /// Records that have counted since before this time are forgotten.
    pub since: SystemTime,
    /// The maximum number of operations.
    pub operations: usize,
    /// The maximum bytes of operations (see [`Operation::bytes`](super::Operation::bytes)).
    pub operation_bytes: usize,
}

/// The records of an index that a journal keeps.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Window {
    /// Their number.
    pub records: u64,
    /// Their bytes (see [`Effects::bytes`](super::Effects::bytes)).
    pub bytes: u64,
}

impl Retention {
    /// Forgets the records that need not be kept, oldest first. `time_of` is the time from which a record counts, in
    /// milliseconds since 1970.
    pub(super) fn forget_records<'a, T>(
        &'a self,
        records: &'a mut BoundedQueue<T>,
        time_of: impl Fn(&T) -> u64 + 'a,
    ) -> impl Iterator<Item = T> + 'a {
        let since = time_ms(self.since);
        std::iter::from_fn(move || {
            records.forget(usize::MAX, self.record_bytes, |record| {
                time_of(record) < since
            })
        })
    }

    /// Forgets the operations that need not be kept, oldest first.
    pub(super) fn forget_operations<'a, T>(
        &'a self,
        operations: &'a mut BoundedQueue<T>,
    ) -> impl Iterator<Item = T> + 'a {
        std::iter::from_fn(move || {
            operations.forget(self.operations, self.operation_bytes, |_| false)
        })
    }
}

/// A queue that forgets its oldest items. The newest item always stays, at any size and age, so that a follower that
/// reads one record at a time always gets the next one.
pub(crate) struct BoundedQueue<T> {
    /// The items with their bytes, oldest first.
    items: VecDeque<(T, usize)>,
    bytes: usize,
}

impl<T> Default for BoundedQueue<T> {
    fn default() -> Self {
        Self {
            items: VecDeque::new(),
            bytes: 0,
        }
    }
}

impl<T> BoundedQueue<T> {
    /// Adds the newest item.
    pub(crate) fn push(&mut self, item: T, bytes: usize) {
        self.bytes += bytes;
        self.items.push_back((item, bytes));
    }

    /// Removes the oldest item if the items exceed a bound, or if it is too old; None if it stays.
    pub(crate) fn forget(
        &mut self,
        max_count: usize,
        max_bytes: usize,
        is_old: impl FnOnce(&T) -> bool,
    ) -> Option<T> {
        let (oldest, _) = self.items.front()?;
        let is_outside = self.items.len() > max_count || self.bytes > max_bytes || is_old(oldest);
        if self.items.len() == 1 || !is_outside {
            return None;
        }
        let (oldest, bytes) = self.items.pop_front()?;
        self.bytes -= bytes;
        Some(oldest)
    }

    /// The items and their bytes, as the window of an index.
    pub(crate) fn window(&self) -> Window {
        Window {
            records: self.items.len() as u64,
            bytes: self.bytes as u64,
        }
    }

    /// The items, oldest first.
    pub(crate) fn iter(&self) -> impl ExactSizeIterator<Item = &T> {
        self.items.iter().map(|(item, _)| item)
    }
}

/// The bytes of records that may still be read. The first record may always be read.
pub(super) struct Allowance {
    left: usize,
    is_first: bool,
}

impl Allowance {
    pub(super) fn of(bytes: usize) -> Self {
        Self {
            left: bytes,
            is_first: true,
        }
    }

    /// True if this record fits into the allowance too.
    pub(super) fn take(&mut self, record: &Record) -> bool {
        let left = self.left.checked_sub(record.effects().bytes());
        self.left = left.unwrap_or(0);
        std::mem::replace(&mut self.is_first, false) || left.is_some()
    }
}

#[cfg(test)]
mod tests {
    use std::{sync::Arc, time::Duration};

    use super::*;
    use crate::{
        log::{Catalogue, Durability, Effects, FjallLog, MemoryLog, PointStore, RecordPosition},
        testing::arm,
    };

    #[test]
    fn a_record_counts_from_its_arrival_if_another_clock_stamped_it() {
        let now = 1_000_000;
        assert_eq!(counted_ms(now - 500, now), now - 500);
        assert_eq!(counted_ms(0, now), now - MAX_AGE_AT_ARRIVAL_MS);
        assert_eq!(counted_ms(u64::MAX, now), now);
        assert_eq!(counted_ms(7, 8), 7);
    }

    /// Forgets what is older than an hour, and returns the number of records that stay of three with the stamp 0.
    fn kept(log: &(impl PointStore + Catalogue)) -> u64 {
        let entry = arm();
        let uid = entry.uid;
        log.create(entry).unwrap();
        let mut position = RecordPosition::START;
        for revision in 1..=3 {
            let record = Record::new(revision, position.digest, 0, Effects::new(1));
            position = record.position();
            assert!(log.submit(uid, Arc::new(record)).is_ok());
        }
        let retention = Retention {
            record_bytes: usize::MAX,
            since: SystemTime::now() - Duration::from_secs(3600),
            operations: usize::MAX,
            operation_bytes: usize::MAX,
        };
        log.trim(uid, &retention).unwrap();
        log.window(uid).unwrap().records
    }

    #[test]
    fn a_window_keeps_the_records_of_a_clock_that_is_far_behind() {
        assert_eq!(kept(&MemoryLog::new()), 3);
        let directory = tempfile::tempdir().unwrap();
        let log = FjallLog::open(directory.path(), Durability::None).unwrap();
        assert_eq!(kept(&log), 3);
    }
}
