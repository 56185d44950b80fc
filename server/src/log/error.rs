//! The errors of the log.

use thiserror::Error;

use super::Uid;

/// The consequence of a failure of the store.
const STORE_FAILED: &str = "the outcome of the mutations under way is unknown, new ones are refused, and reads go on; \
                            the server tries repeatedly to reopen the store";

/// The error of a call of the log.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
pub enum LogError {
    /// No index has this uid, or the index was deleted.
    #[error("the log holds no index with the uid {uid}")]
    UnknownIndex {
        /// The uid.
        uid: Uid,
    },
    /// An index with this uid exists. Uids are never used twice.
    #[error("the log holds an index with the uid {uid} already")]
    UidTaken {
        /// The uid.
        uid: Uid,
    },
    /// Another server has given this name to an index.
    #[error("another server has created an index named \"{name}\"")]
    NameTaken {
        /// The name.
        name: String,
    },
    /// The journal ends before what this server has applied. The server looks again: NATS may have answered with stale
    /// data.
    #[error(
        "index {uid}: the journal ends at revision {head}, and this server has applied {applied}: NATS has lost the \
         records between, or answers with an older state; nothing is written, and reads go on; call again, or call another \
         server. If it lasts, stop this server and run `wayfold-server reseed`"
    )]
    JournalBehind {
        /// The index.
        uid: Uid,
        /// The newest revision of the journal.
        head: u64,
        /// The newest revision that this server has applied.
        applied: u64,
    },
    /// A record of a journal that several servers share is damaged or missing. A server that cannot apply it takes a copy of
    /// another one.
    #[error(
        "index {uid}: the record of revision {revision} in the journal is damaged: {what}; nothing is \
         written until this server has a copy of another one, and reads go on; call again, or call another server. If \
         it lasts at all servers, stop one and run `wayfold-server reseed` there"
    )]
    JournalDamaged {
        /// The index.
        uid: Uid,
        /// The revision that the record should have.
        revision: u64,
        /// The damage.
        what: &'static str,
    },
    /// Another server has applied a record that differs from the one that this server has applied at its revision.
    #[error(
        "index {uid}: {member} has applied another record of revision {revision}: NATS has lost acknowledged records, \
         and others took their place; nothing is written to the index any more, and reads go on. Choose the server whose \
         records stay, keep what you need of the points of the others, and run `wayfold-server reseed` there"
    )]
    Contradicted {
        /// The index.
        uid: Uid,
        /// The revision.
        revision: u64,
        /// The other server.
        member: String,
    },
    /// NATS does not answer.
    #[error("NATS does not answer ({what}); the server tries again, and so can you")]
    Unreachable {
        /// The problem.
        what: String,
    },
    /// Another writer was first.
    #[error("index {uid}: the newest revision is {head}, not {expected}: another writer was first")]
    Fenced {
        /// The index.
        uid: Uid,
        /// The revision that the writer expected to be the newest.
        expected: u64,
        /// The newest revision.
        head: u64,
    },
    /// The journal's answer to a record was lost: the record may be in the journal or not.
    #[error(
        "index {uid}: the answer to the record of revision {revision} was lost ({what}): it may be in the journal \
         or not; read what you wrote, or repeat the call with the same operation_id"
    )]
    Unconfirmed {
        /// The index.
        uid: Uid,
        /// The revision of the record.
        revision: u64,
        /// The cause.
        what: String,
    },
    /// The journal never takes a record as large as that of the mutation. Nothing was submitted.
    #[error(
        "index {uid}: the record of the mutation takes {bytes} bytes, and the journal takes {max_bytes} at most"
    )]
    RecordTooLarge {
        /// The index.
        uid: Uid,
        /// The bytes of the record.
        bytes: usize,
        /// The bytes of the largest record that the journal takes.
        max_bytes: usize,
    },
    /// Requested records have been trimmed.
    #[error("index {uid}: the records after revision {after} are held only from {oldest} on")]
    Trimmed {
        /// The index.
        uid: Uid,
        /// The revision whose successors were requested.
        after: u64,
        /// The oldest revision whose successors are held.
        oldest: u64,
    },
    /// Stored records or points of an index are missing, or differ from the written ones.
    #[error("{what}; restore the index from a snapshot, or delete it and create it again ({uid})")]
    Damaged {
        /// The index.
        uid: Uid,
        /// A revision that its readers may have seen; 0 if none is known.
        seen: u64,
        /// The damage.
        what: String,
    },
    /// The store read bytes that differ from the written ones.
    #[error(
        "a part of its stored records and points is damaged ({what}); restore the index from a snapshot, or \
         delete it and create it again ({uid})"
    )]
    Unreadable {
        /// The index.
        uid: Uid,
        /// The error of the store.
        what: String,
    },
    /// The store as a whole cannot be read.
    #[error(
        "the store cannot be opened ({what}): its content cannot be read{}; put back the newest state of the file, or \
         name another directory with --data and restore the indices from snapshots (never use an older copy of the \
         directory: the server cannot tell it from the present one)",
        match revision {
            0 => String::new(),
            revision => format!(", among it the revisions 1 to {revision} of this index"),
        }
    )]
    Unopened {
        /// The newest revision that is known to have been synced; 0 if the error concerns no single index.
        revision: u64,
        /// The error of the store.
        what: String,
    },
    /// The disk prevents the store from being opened.
    #[error(
        "the store cannot be opened ({what}): nothing is read or written until the disk can be used again; the server \
         tries repeatedly to open it"
    )]
    Shut {
        /// The error of the disk.
        what: String,
    },
    /// Synced revisions are missing, which may have been acknowledged.
    #[error(
        "{} stored and gone: the files of the log were cut short, damaged or replaced; put back their newest state, \
         restore the index from a snapshot, or delete it and create it again ({uid})",
        match last.checked_sub(*first) {
            None => "its creation was".to_owned(),
            Some(0) => format!("revision {first} was"),
            Some(_) => format!("the revisions {first} to {last} were"),
        }
    )]
    Lost {
        /// The index.
        uid: Uid,
        /// The first revision that is missing.
        first: u64,
        /// The last revision that is known to have been synced. It is less than `first` if only the creation was
        /// synced.
        last: u64,
    },
    /// A server of a cluster cannot read its own copy of an index.
    #[error(
        "this server cannot read its copy of the index ({what}): call another server, which may have another copy. \
         docs/operations.md tells how this server gets one"
    )]
    CopyUnreadable {
        /// The damage.
        what: String,
    },
    /// The store failed: nothing more is written until it is reopened.
    #[error("the store failed ({what}): {STORE_FAILED}")]
    Storage {
        /// The error of the store.
        what: String,
    },
    /// A thread of the store failed earlier, and the store does not say why. The consequence is that of
    /// [`LogError::Storage`].
    #[error("the store failed (an earlier failure to write): {STORE_FAILED}")]
    StorageStopped,
    /// The store met a damaged block and writes nothing more.
    #[error(
        "the store is damaged ({what}): nothing is written any more, and reads go on; stop the server and run \
         `wayfold-server repair`"
    )]
    DamagedStore {
        /// The error of the store.
        what: String,
    },
    /// The store was closed.
    #[error("the store was closed or reopened during the call: retry it")]
    Closed,
}

impl LogError {
    /// The stored record of this revision is missing, or differs from the written one.
    pub fn damaged_record(uid: Uid, revision: u64, what: &str) -> Self {
        Self::Damaged {
            uid,
            seen: 0,
            what: format!("the record of revision {revision} is damaged: {what}"),
        }
    }

    /// The stored point with this id differs from the written one.
    pub fn damaged_point(uid: Uid, id: u64, what: &str) -> Self {
        Self::Damaged {
            uid,
            seen: 0,
            what: format!("the point with id {id} is damaged: {what}"),
        }
    }

    /// The writer expected another revision than `head` to be the newest.
    pub const fn fenced(uid: Uid, expected: u64, head: u64) -> Self {
        Self::Fenced {
            uid,
            expected,
            head,
        }
    }

    /// Of the records after the revision `after`, only those after `oldest` are held.
    pub const fn trimmed(uid: Uid, after: u64, oldest: u64) -> Self {
        Self::Trimmed { uid, after, oldest }
    }

    /// The record of this revision in the journal is damaged or missing.
    pub const fn journal_damaged(uid: Uid, revision: u64, what: &'static str) -> Self {
        Self::JournalDamaged {
            uid,
            revision,
            what,
        }
    }

    /// The error for the caller of a server whose points others have too: the loss of this copy is no loss of the index.
    pub(crate) fn of_copy(self) -> Self {
        let what = match self {
            Self::Damaged { what, .. } => what,
            Self::Unreadable { what, .. } => format!("a part of its store is damaged: {what}"),
            Self::Unopened { what, .. } => format!("its store cannot be opened: {what}"),
            Self::Lost { last, .. } => {
                format!(
                    "files were cut short or replaced: it does not have all records up to revision {last}"
                )
            }
            other => return other,
        };
        Self::CopyUnreadable { what }
    }

    /// The journal has lost the record of a revision that this server has applied, and another one took its place.
    pub(crate) const fn replaced(uid: Uid, revision: u64) -> Self {
        Self::journal_damaged(uid, revision, "the journal has another one in its place")
    }
}
