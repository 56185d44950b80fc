//! The part of its history that a journal keeps: the newest records, for its followers, and the newest operations, for
//! retries.

use std::{collections::VecDeque, time::SystemTime};

use super::{Record, record::time_ms};

/// The bounds on the records and operations of an index that are kept.
#[derive(Clone, Copy, Debug)]
pub struct Retention {
    /// The maximum bytes of records (see [`Effects::bytes`](super::Effects::bytes)).
    pub record_bytes: usize,
    /// Records older than this are forgotten.
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
    /// Forgets the records that need not be kept, oldest first. `time_of` is the time of a record in milliseconds
    /// since 1970.
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
