//! The mutation log: the server's only source of state.
//!
//! The server is one state machine, *mutation log → forest*. A mutation is evaluated, its [`Effects`] are submitted to
//! the [`Journal`] as one [`Record`], and the apply loop of the index (`registry`) takes the record from the journal
//! and applies it to the [`PointStore`] and the forest. A restart and a feed read the same records. A record holds the
//! effects of a mutation, never the request, so applying one decides nothing.
//!
//! The point store holds the sum of the records ([`View`]): the checkpoint from which a restart goes on, and the place
//! where payloads live. The [`Catalogue`] holds the names and uids of the indices.
//!
//! Two engines implement all three: `fjall` in a directory, where a record and the points that it changes are one
//! batch, and `memory` in the process. Several servers share a journal and a catalogue in `nats`, each over one of these
//! engines. One conformance suite runs over all, over an engine that fails on purpose, and over a journal that behaves
//! like one on another machine.
//!
//! Invariants:
//! - The revisions of an index start at 1 and have no gaps; record `n` carries the digest of record `n - 1`. Every
//!   record takes a revision, also one without points.
//! - Of two writers that submit after the same revision one wins, and the other is refused ([`LogError::Fenced`]).
//! - A view never changes, whatever is applied, trimmed or deleted while it is held.
//! - A uid is never used again.

mod cursor;
mod effects;
mod entry;
mod error;
mod fjall;
mod following;
mod memory;
mod nats;
mod record;
mod retention;
mod session;
mod uid;
mod unapplied;
mod view;

use std::sync::Arc;

use futures_util::{future::BoxFuture, stream::BoxStream};
use tokio::sync::watch;

#[cfg(fuzzing)]
pub use self::fjall::fuzzing;
pub use self::fjall::{
    Durability, FjallLog, OpenError, RepairError, RepairReport, StoreOptions, repair,
};
pub(crate) use self::fjall::{SYNCS, make_directory};
pub use effects::{Effects, Operation, Outcome};
pub(crate) use entry::MAX_NAME_BYTES;
pub use entry::{Entry, LostIndex, Origin};
pub use error::LogError;
pub use memory::MemoryLog;
pub(crate) use nats::open as open_nats;
pub use nats::{NatsError, NatsOptions, connect as connect_nats};
pub(crate) use record::position_after;
pub use record::{Digest, Record, RunId};
pub(crate) use retention::BoundedQueue;
pub use retention::{Retention, Window};
pub use session::{Batch, Block, Session, Sessions};
pub use uid::Uid;
pub use view::{StoredPoint, View};

/// A record's place in the log of its index. Two servers may give their records the same revision, but never the same
/// digest: a record names the run of its server.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RecordPosition {
    /// Its revision.
    pub revision: u64,
    /// Its digest.
    pub digest: Digest,
}

impl RecordPosition {
    /// The position before the first record of an index.
    pub const START: Self = Self {
        revision: 0,
        digest: Record::NO_PREVIOUS,
    };
}

/// A stream of batches of consecutive records. It waits for new records at the end of the log, and ends after an error.
pub type RecordStream = BoxStream<'static, Result<Vec<Arc<Record>>, LogError>>;

/// Takes the points of an index one by one.
pub type PointVisitor<'a> = dyn FnMut(&StoredPoint) -> Result<(), LogError> + 'a;

/// The number of points that one read of a view returns while an index is loaded.
const PAGE_POINTS: usize = 4096;

/// The answer of a [`Journal`] to a submitted record.
pub enum Receipt {
    /// The journal cannot refuse the record any more. [`Journal::follow`] yields it once it is durable, or an error.
    Accepted,
    /// Resolves once the journal has accepted or refused the record: [`LogError::Fenced`] if another writer has its
    /// revision, [`LogError::Unconfirmed`] if the answer was lost, so that the record may be in the journal or not.
    Awaited(BoxFuture<'static, Result<(), LogError>>),
}

/// The records of all indices, in the order of their revisions. The journal is the only source of truth.
///
/// A [`LogError::Storage`] ends all writing, until [`PointStore::reopen`] succeeds; reading goes on.
pub trait Journal: Send + Sync {
    /// Submits a record, which names the record that it follows. An error means that the record is not in the journal:
    /// [`LogError::Fenced`] if it does not follow the newest. Records may be submitted while earlier ones are under
    /// way. May block if [`Journal::is_busy`], or if points are replaced or removed.
    fn submit(&self, uid: Uid, record: Arc<Record>) -> Result<Receipt, LogError>;

    /// Fails with [`LogError::RecordTooLarge`] if the journal never takes the record of these effects.
    fn check_size(&self, _: Uid, _: &Effects) -> Result<(), LogError> {
        Ok(())
    }

    /// Publishes the first record of a restored index, which follows its origin. A shared journal takes it only if it has no
    /// record of the index; the journal of the same engine begins at the origin by itself. Blocks.
    fn begin(&self, _: Uid, _: Arc<Record>) -> Result<(), LogError> {
        Ok(())
    }

    /// The records after the revision `after`, once they are as durable as this journal makes them.
    fn follow(&self, uid: Uid, after: u64) -> RecordStream;

    /// Like [`Journal::follow`], after a record that this server has applied. If a shared journal has another record there,
    /// the stream ends with [`LogError::JournalDamaged`].
    fn follow_applied(&self, uid: Uid, applied: RecordPosition) -> RecordStream {
        self.follow(uid, applied.revision)
    }

    /// The records after the revision `after` that the journal holds, durable or not; all records if `after` is None.
    /// Returns the first records that fit into `max_bytes` (see [`Effects::bytes`]), but at least one.
    /// [`LogError::Trimmed`] if some of them are no longer held. Blocks.
    fn read(
        &self,
        uid: Uid,
        after: Option<u64>,
        max_bytes: usize,
    ) -> Result<Vec<Arc<Record>>, LogError>;

    /// The oldest revision that the journal has; None if it has no record. Blocks.
    fn oldest(&self, uid: Uid) -> Result<Option<u64>, LogError> {
        let oldest = self.read(uid, None, 1)?;
        Ok(oldest.first().map(|oldest| oldest.revision()))
    }

    /// The newest revision that the journal has, durable or not. Blocks.
    fn newest(&self, uid: Uid) -> Result<u64, LogError>;

    /// Forgets the records up to this revision of a shared journal, which enough servers store, except those that this
    /// server keeps itself and the newest of the journal. Blocks.
    fn forget(&self, _: Uid, _up_to: u64) -> Result<(), LogError> {
        Ok(())
    }

    /// Submits again the newest records that a shared journal has lost and that this server has applied. Returns their
    /// number. [`LogError::Contradicted`] if they do not follow what the journal has, [`LogError::UnknownIndex`] if another
    /// server has deleted the index. Blocks.
    fn repair(&self, _: Uid) -> Result<u64, LogError> {
        Ok(0)
    }

    /// True if the next [`Journal::submit`], or [`PointStore::apply`] of records that are not in the store yet, may block on
    /// the store; call it from a blocking thread then.
    fn is_busy(&self) -> bool {
        false
    }

    /// False while the journal cannot be reached.
    fn is_reachable(&self) -> bool {
        true
    }

    /// True if other servers may submit records too.
    fn is_shared(&self) -> bool {
        false
    }
}

/// The points of all indices as of the newest record that was applied: the local checkpoint, where payloads live. Its
/// [`Journal`] side returns the newest applied records, also those that came from a shared journal.
pub trait PointStore: Journal {
    /// Applies consecutive records of an index, and returns its points as of the last of them. A record that was
    /// submitted to this engine is in the store already and is not applied again. `records` is not empty. May block as
    /// [`Journal::submit`] does.
    fn apply(&self, uid: Uid, records: &[Arc<Record>]) -> Result<Arc<dyn View>, LogError>;

    /// The points as they are stored now, pinned.
    fn view(&self, uid: Uid) -> Result<Arc<dyn View>, LogError>;

    /// Passes all points, by ascending id, to `visit`, and returns their view; an error of `visit` ends it. Blocks.
    fn load(&self, uid: Uid, visit: &mut PointVisitor<'_>) -> Result<Arc<dyn View>, LogError> {
        let view = self.view(uid)?;
        let mut after = None;
        loop {
            let page = view.page(after, PAGE_POINTS)?;
            let Some(last) = page.last() else {
                return Ok(view);
            };
            after = Some(last.id);
            page.iter().try_for_each(|point| visit(point))?;
        }
    }

    /// Forgets the oldest records and operations that need not be kept, but never the newest of each. A follower still gets
    /// the records that this store has not applied.
    fn trim(&self, uid: Uid, retention: &Retention) -> Result<(), LogError>;

    /// The records that this server keeps of an index.
    fn window(&self, uid: Uid) -> Result<Window, LogError>;

    /// The record of this revision; None if this server does not keep it. Blocks.
    fn retained(&self, uid: Uid, revision: u64) -> Result<Option<Arc<Record>>, LogError> {
        let Some(before) = revision.checked_sub(1) else {
            return Ok(None);
        };
        match self.read(uid, Some(before), 1) {
            Ok(records) => Ok(records.into_iter().find(|it| it.revision() == revision)),
            Err(LogError::Trimmed { .. }) => Ok(None),
            Err(error) => Err(error),
        }
    }

    /// The newest operations, oldest first. Operations of trimmed records are included.
    fn operations(&self, uid: Uid) -> Result<Vec<Arc<Operation>>, LogError>;

    /// Starts an index as a copy of another: at a revision, with points and without records. It appears once the
    /// copy is finished, whole or not at all.
    ///
    /// A copy that `replaces` takes the place of the index with its uid, at the same record or a later one; `origin` has the
    /// digest of that record. Until the copy is finished, the index stays as it is; then it has all of the copy, and a crash
    /// leaves the one or the other. Earlier views stay valid. [`PointWriter::finish`] fails with [`LogError::UnknownIndex`] if
    /// the index was deleted meanwhile, and with [`LogError::Fenced`] if it can be read and its newest record is neither that
    /// of the copy nor an earlier one.
    fn restore(
        &self,
        entry: Entry,
        origin: Origin,
        replaces: bool,
    ) -> Result<Box<dyn PointWriter>, LogError>;

    /// The newest revision of an index that survives a loss of power here; None if nothing does.
    fn durable(&self, _: Uid) -> Result<Option<u64>, LogError> {
        Ok(None)
    }

    /// The failure after which nothing is written.
    fn failure(&self) -> Option<LogError> {
        None
    }

    /// The memory and the disk of the store. Blocks.
    fn usage(&self) -> StoreUsage {
        StoreUsage::default()
    }

    /// Reopens a failed store once its disk can be used. Each index then has its stored state. Records that were not
    /// durable may be missing. Earlier views fail with [`LogError::Closed`]. A damaged store is reopened for reading
    /// only, and [`PointStore::failure`] still returns the damage.
    fn reopen(&self) -> Result<(), LogError> {
        Ok(())
    }
}

/// The bytes that a store takes; 0 for what it cannot tell.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct StoreUsage {
    /// Its memory: the blocks that it has read, and the points that it has yet to move out of the journal.
    pub memory: u64,
    /// The disk of the journal.
    pub journal: u64,
    /// The disk of the files into which it moves the journal's content.
    pub tables: u64,
    /// The rest of the data directory.
    pub other: u64,
}

/// The indices, by name and uid.
pub trait Catalogue: Send + Sync {
    /// All indices, in no particular order. Unreadable indices are included; [`PointStore::view`] returns the cause.
    fn indexes(&self) -> Result<Vec<Entry>, LogError>;

    /// The indices whose data is lost. They can be deleted.
    fn lost(&self) -> Vec<LostIndex> {
        Vec::new()
    }

    /// Adds a new index, at revision 0. [`LogError::NameTaken`] if another server has given its name to an index.
    fn create(&self, entry: Entry) -> Result<(), LogError>;

    /// Gives a name to an index that the point store has already: a restored one. `replaced` may have the
    /// name, and counts as deleted. [`LogError::NameTaken`] if another index has it. With any other error it is unknown which index
    /// has the name.
    fn claim(&self, _: &Entry, _replaced: Option<Uid>) -> Result<(), LogError> {
        Ok(())
    }

    /// Deletes an index with its records and points. Existing views stay valid.
    fn delete(&self, uid: Uid) -> Result<(), LogError>;

    /// Notes for all servers that two of them have applied different records of this revision. Blocks.
    fn note_contradiction(&self, _: Uid, _revision: u64) -> Result<(), LogError> {
        Ok(())
    }

    /// The revision of a contradiction that a server has noted. It stays noted while the index of this name has this uid.
    fn contradiction(&self, _name: &str, _: Uid) -> Option<u64> {
        None
    }

    /// True if `uid` can no longer become the uid of this name here; false in doubt. `hosted` is the uid that it has.
    fn is_past(&self, _name: &str, _uid: &str, _hosted: Option<Uid>) -> bool {
        true
    }

    /// Notified of the changes that other servers make; None if no other server can.
    fn changes(&self) -> Option<watch::Receiver<()>> {
        None
    }
}

/// The three parts of a log: one engine, or a shared journal and a local point store.
#[derive(Clone)]
pub struct Log {
    /// Its records.
    pub journal: Arc<dyn Journal>,
    /// Their sum.
    pub points: Arc<dyn PointStore>,
    /// Its indices.
    pub catalogue: Arc<dyn Catalogue>,
}

impl<Engine: PointStore + Catalogue + 'static> From<Arc<Engine>> for Log {
    fn from(engine: Arc<Engine>) -> Self {
        Self {
            journal: Arc::clone(&engine) as Arc<dyn Journal>,
            points: Arc::clone(&engine) as Arc<dyn PointStore>,
            catalogue: engine,
        }
    }
}

/// An index that is being restored. If it is dropped before [`PointWriter::finish`], nothing is left behind.
pub trait PointWriter: Send {
    /// Adds the next points, by ascending id.
    fn add(&mut self, points: &[StoredPoint]) -> Result<(), LogError>;

    /// Adds the index to the catalogue with these writer sessions and these operations, oldest first, durably.
    /// [`LogError::Damaged`] if there are more operations than revisions.
    fn finish(
        self: Box<Self>,
        sessions: Sessions,
        operations: Vec<Arc<Operation>>,
    ) -> Result<(), LogError>;
}
