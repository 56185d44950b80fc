//! The mutation log: the server's only source of state.
//!
//! The server is one state machine, *mutation log → forest*. A mutation is evaluated against the head, its
//! [`Effects`] are appended as one [`Record`], and the record is applied to the forest. Whatever else needs to know
//! what happened (a restart, a feed, a replica) reads the same records. Replaying one decides nothing: a record holds
//! what a mutation did, never what was asked.
//!
//! Besides its records a log keeps their sum, the *points* of each index as of its head ([`View`]): the checkpoint
//! from which replay starts, and the place where payloads live.
//!
//! The stores: `fjall` keeps the log in a directory, `memory` in the process. One suite runs over these, and over one
//! that fails on purpose.
//!
//! Invariants of every [`Log`]:
//! - The revisions of an index start at 1 and have no gaps; record `n` carries the digest of record `n - 1`.
//! - Of two writers that append after the same revision one wins, and the other is refused ([`LogError::Fenced`]).
//! - A view never changes, whatever is appended, trimmed or deleted while it is held.
//! - A uid is never used again.

mod cursor;
mod error;
mod fjall;
mod memory;
mod record;
mod uid;
mod window;

use std::sync::Arc;

use bytes::Bytes;
use futures_util::future::BoxFuture;
use wayfold_index::Space;

#[cfg(fuzzing)]
pub use self::fjall::fuzzing;
pub use self::fjall::{Durability, FjallLog, OpenError, RepairError, RepairReport, repair};
pub use error::LogError;
pub use memory::MemoryLog;
pub use record::{Digest, Effects, Operation, Outcome, Record};
pub use uid::Uid;
pub use window::Keep;

/// An index as the log knows it. That names are unique is the registry's care.
#[derive(Clone, Debug, PartialEq)]
pub struct Entry {
    /// Names its past.
    pub uid: Uid,
    /// Its name.
    pub name: String,
    /// Its space.
    pub space: Space,
}

/// An index of which the log knows that it was there, and not what it held.
#[derive(Clone, Debug, PartialEq)]
pub struct Gone {
    /// Its name.
    pub name: String,
    /// Its uid.
    pub uid: Uid,
    /// What became of it.
    pub why: LogError,
}

/// Where the log of an index begins.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Origin {
    /// Its first revision: that of its first points.
    pub revision: u64,
    /// The least id above every id that was ever stored.
    pub next_id: u64,
    /// What its first record carries for the digest of the record before.
    pub digest: Digest,
}

impl Origin {
    /// Of an index that begins with nothing.
    pub const START: Self = Self {
        revision: 0,
        next_id: 0,
        digest: Record::NO_PREVIOUS,
    };
}

/// A store of mutation logs, one for each index.
///
/// A [`LogError::Storage`] ends all writing, until [`Log::reopen`] succeeds; reading goes on.
pub trait Log: Send + Sync {
    /// All indices, in no particular order; also those that cannot be read, of which [`Log::points`] says why.
    fn indexes(&self) -> Result<Vec<Entry>, LogError>;

    /// The indices of which nothing is left but that they were there. They can be deleted.
    fn gone(&self) -> Vec<Gone> {
        Vec::new()
    }

    /// Starts the log of a new index, at revision 0.
    fn create(&self, entry: Entry) -> Result<(), LogError>;

    /// Starts the log of a new index that begins as a copy of another: at a revision, with points and without records.
    /// It is there once the copy is finished, whole or not at all.
    fn restore(&self, entry: Entry, origin: Origin) -> Result<Box<dyn Restoring>, LogError>;

    /// Deletes an index's records and points. Views that are held stay as they are.
    fn delete(&self, uid: Uid) -> Result<(), LogError>;

    /// Appends one record after `expected`, the revision that the writer takes for the head; the record's revision is
    /// the next. On return [`Log::tail`] and [`Log::points`] show the record, but only [`Log::synced`] says when it
    /// will survive a crash.
    fn append(&self, uid: Uid, expected: u64, effects: Effects) -> Result<Arc<Record>, LogError>;

    /// Resolves once the record of `revision`, and so every one before it, is as durable as this log makes it, to the
    /// newest revision of which that is so then.
    fn synced(&self, uid: Uid, revision: u64) -> BoxFuture<'static, Result<u64, LogError>>;

    /// The records after the revision `after`, intact and each the successor of the one before; None for all that are
    /// still held. Only the first of them, as many as take `most` bytes (see [`Effects::bytes`]), but at least one.
    /// [`LogError::Trimmed`] if some of them are held no longer.
    fn tail(&self, uid: Uid, after: Option<u64>, most: usize)
    -> Result<Vec<Arc<Record>>, LogError>;

    /// The points as of the head, pinned.
    fn points(&self, uid: Uid) -> Result<Arc<dyn View>, LogError>;

    /// The newest operations among those of all records, the oldest first; also of records that are held no longer.
    fn operations(&self, uid: Uid) -> Result<Vec<Arc<Operation>>, LogError>;

    /// Forgets the oldest records and operations that need not be kept, but never the newest of each.
    fn trim(&self, uid: Uid, keep: &Keep) -> Result<(), LogError>;

    /// Whether the next append may have to wait until the store has caught up: it is better made where one may block.
    fn is_busy(&self) -> bool {
        false
    }

    /// Why nothing is written any more.
    fn failure(&self) -> Option<LogError> {
        None
    }

    /// Reopens a failed store once its disk can be used. Then each index is as it is stored: mutations that were not synced
    /// are there or not. Views from before are [`LogError::Closed`]. A damaged store is reopened for reading, and
    /// [`Log::failure`] still tells of it.
    fn reopen(&self) -> Result<(), LogError> {
        Ok(())
    }
}

/// An index that is being restored. Dropped before it is finished, it leaves nothing.
pub trait Restoring: Send {
    /// Adds the next points, by ascending id.
    fn add(&mut self, points: &[StoredPoint]) -> Result<(), LogError>;

    /// Makes the index one of the log's, for certain.
    fn finish(self: Box<Self>) -> Result<(), LogError>;
}

/// The points of one index as of one revision, for as long as it is held: the sum of the records up to there.
pub trait View: Send + Sync {
    /// The revision.
    fn revision(&self) -> u64;

    /// The least id above every id that was ever stored, by this revision or an earlier one.
    fn next_id(&self) -> u64;

    /// The point with this id.
    fn get(&self, id: u64) -> Result<Option<Arc<StoredPoint>>, LogError>;

    /// Up to `limit` points with ids above `after` (from the first if None), by ascending id.
    fn page(&self, after: Option<u64>, limit: usize) -> Result<Vec<Arc<StoredPoint>>, LogError>;
}

/// A point as the log stores it.
#[derive(Clone, Debug, PartialEq)]
pub struct StoredPoint {
    /// Its id.
    pub id: u64,
    /// The revision that stored its state.
    pub revision: u64,
    /// The revision that last changed its state, its tag or its payload.
    pub modified: u64,
    /// Its tag.
    pub tag: u64,
    /// Its state: a canonical row.
    pub state: Box<[f64]>,
    /// Its payload.
    pub payload: Bytes,
}
