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

/// The sizes of the records and operations that are held. The newest record and the newest operation always stay, at
/// any size and age, so a follower that reads record by record always gets the next one.
#[derive(Default)]
pub(super) struct Window {
    records: VecDeque<Held>,
    record_bytes: usize,
    operations: VecDeque<usize>,
    operation_bytes: usize,
}

struct Held {
    bytes: usize,
    time_ms: u64,
}

/// The numbers of oldest records and operations to forget.
#[derive(Default)]
pub(super) struct Trimmed {
    pub(super) records: usize,
    pub(super) operations: usize,
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

impl Window {
    /// Adds the next record.
    pub(super) fn hold(&mut self, record: &Record) {
        let bytes = record.effects().bytes();
        self.record_bytes += bytes;
        let time_ms = record.time_ms();
        self.records.push_back(Held { bytes, time_ms });
    }

    /// Adds the next operation.
    pub(super) fn hold_operation(&mut self, bytes: usize) {
        self.operation_bytes += bytes;
        self.operations.push_back(bytes);
    }

    /// Drops the records and operations outside the bounds.
    pub(super) fn trim(&mut self, keep: &Retention) -> Trimmed {
        let mut trimmed = Trimmed::default();
        let since = time_ms(keep.since);
        while self.records.len() > 1
            && let Some(oldest) = self.records.front()
            && (self.record_bytes > keep.record_bytes || oldest.time_ms < since)
        {
            self.record_bytes -= oldest.bytes;
            self.records.pop_front();
            trimmed.records += 1;
        }
        while self.operations.len() > 1
            && let Some(oldest) = self.operations.front()
            && (self.operations.len() > keep.operations
                || self.operation_bytes > keep.operation_bytes)
        {
            self.operation_bytes -= oldest;
            self.operations.pop_front();
            trimmed.operations += 1;
        }
        trimmed
    }
}
