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
//! The stores: `fjall` keeps the log in a directory, `memory` in the process. One suite runs over both.
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

use std::sync::Arc;

use bytes::Bytes;
use futures_util::future::BoxFuture;
use wayfold_index::Space;

pub use self::fjall::{Durability, FjallLog, OpenError};
pub use error::LogError;
pub use memory::MemoryLog;
pub use record::{Digest, Effects, Operation, Outcome, Record};
pub use uid::Uid;

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

/// A store of mutation logs, one for each index.
pub trait Log: Send + Sync {
    /// All indices, in no particular order.
    fn indexes(&self) -> Result<Vec<Entry>, LogError>;

    /// Starts the log of a new index, at revision 0.
    fn create(&self, entry: Entry) -> Result<(), LogError>;

    /// Deletes an index's records and points. Views that are held stay as they are.
    fn delete(&self, uid: Uid) -> Result<(), LogError>;

    /// Appends one record after `expected`, the revision that the writer takes for the head; the record's revision is
    /// the next. On return [`Log::tail`] and [`Log::points`] show the record, but only [`Log::synced`] says when it
    /// will survive a crash.
    fn append(&self, uid: Uid, expected: u64, effects: Effects) -> Result<Arc<Record>, LogError>;

    /// Resolves once the record of `revision`, and so every one before it, is as durable as this log makes it.
    fn synced(&self, uid: Uid, revision: u64) -> BoxFuture<'static, Result<(), LogError>>;

    /// The records after the revision `after`; None for all that are still held. [`LogError::Trimmed`] if some of
    /// them are held no longer.
    fn tail(&self, uid: Uid, after: Option<u64>) -> Result<Vec<Arc<Record>>, LogError>;

    /// The points as of the head, pinned.
    fn points(&self, uid: Uid) -> Result<Arc<dyn View>, LogError>;

    /// Forgets the oldest records until those left take at most `keep_bytes` (see [`Effects::bytes`]), but never the
    /// newest: who follows record by record always gets the next.
    fn trim(&self, uid: Uid, keep_bytes: usize) -> Result<(), LogError>;
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
