//! The errors of snapshots.

use std::{fmt, io};

use thiserror::Error;
use wayfold_index::StateError;

use super::{FORMAT_VERSION, MAX_CONTENT_BYTES, MAX_PAYLOAD_BYTES, OLDEST_FORMAT_VERSION};
use crate::{END_OF_IDS, space::SpaceMessageError};

/// The error of a snapshot, or of a file that is none.
#[derive(Debug, Error)]
pub enum SnapshotError {
    /// The file cannot be read or written.
    #[error(transparent)]
    Io(io::Error),
    /// The file is not a snapshot.
    #[error("not a snapshot: it does not begin with the line `wayfold snapshot VERSION`")]
    NotSnapshot,
    /// The snapshot has another version of the format.
    #[error(
        "a snapshot of format version {found}, and this program reads versions {OLDEST_FORMAT_VERSION} to \
         {FORMAT_VERSION}: use the release that wrote it"
    )]
    Version {
        /// The version.
        found: String,
    },
    /// It ends before its trailer.
    #[error(
        "the snapshot is cut short: it ends after {parts} whole parts, without its trailer; copy it or take it again"
    )]
    CutShort {
        /// The number of whole parts.
        parts: u64,
    },
    /// Something follows its trailer.
    #[error("something follows the trailer, which is part {part}: this is no snapshot alone")]
    Trailing {
        /// The number of the trailer.
        part: u64,
    },
    /// A part is too large to be one.
    #[error(
        "part {part}: {bytes} bytes, where a part has at most {MAX_CONTENT_BYTES}: damaged, or not a snapshot"
    )]
    TooLarge {
        /// The part.
        part: u64,
        /// Its size in bytes, or the size that it states.
        bytes: u64,
    },
    /// Another part is where this one belongs.
    #[error("part {found} is where part {part} belongs: parts are missing, or not in their order")]
    Order {
        /// The part that belongs there.
        part: u64,
        /// The one that is there.
        found: u64,
    },
    /// A part is damaged: its digest does not match its content.
    #[error(
        "part {part} does not match its checksum: the snapshot is damaged there; copy it or take it again"
    )]
    Damaged {
        /// The part.
        part: u64,
    },
    /// The content of a part does not decode, or is of another kind than its place requires.
    #[error("part {part} cannot be understood: {problem}")]
    Malformed {
        /// The part.
        part: u64,
        /// The problem with it.
        problem: String,
    },
    /// The space of the header is invalid.
    #[error("part {part}: space.{problem}")]
    Space {
        /// The part.
        part: u64,
        /// The problem with it.
        problem: Box<SpaceMessageError>,
    },
    /// A column of points is too short or too long.
    #[error("part {part}: {found} {column}, where {expected} belong to its points")]
    Column {
        /// The part.
        part: u64,
        /// The column.
        column: &'static str,
        /// The number of its entries.
        found: usize,
        /// The number expected.
        expected: usize,
    },
    /// A point that no index holds.
    #[error("{position}: {problem}")]
    Point {
        /// The position of the point.
        position: PointPosition,
        /// The problem with it.
        problem: Box<PointProblem>,
    },
    /// A writer session that no index holds.
    #[error("part {part}, session {session}: {problem}")]
    Session {
        /// The part.
        part: u64,
        /// The session.
        session: u64,
        /// The problem with it.
        problem: SessionProblem,
    },
    /// A block of reserved ids that no index holds.
    #[error("part {part}, block of ids from {first_id}: {problem}")]
    Block {
        /// The part.
        part: u64,
        /// The first id.
        first_id: u64,
        /// The problem with it.
        problem: BlockProblem,
    },
    /// There are more or fewer points, writer sessions or blocks than were announced.
    #[error("part {part}: {found} {counted} so far, where the {said_by} says {expected}")]
    Count {
        /// The part.
        part: u64,
        /// The things that are counted.
        counted: &'static str,
        /// Their number.
        found: u64,
        /// The number expected.
        expected: u64,
        /// The part that announces the number.
        said_by: &'static str,
    },
}

/// The position of a point in a snapshot.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PointPosition {
    /// The part.
    pub part: u64,
    /// Its row in the part, from 0.
    pub row: usize,
    /// Its id.
    pub id: u64,
}

impl fmt::Display for PointPosition {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let PointPosition { part, row, id } = self;
        write!(f, "part {part}, point {row} (id {id})")
    }
}

/// A problem with a point.
#[derive(Clone, Debug, PartialEq, Error)]
pub enum PointProblem {
    /// The ids do not ascend.
    #[error("its id follows {before}, and ids ascend")]
    NotAscending {
        /// The id before.
        before: u64,
    },
    /// An id that the header excludes.
    #[error("ids are below next_id, which is {next_id}")]
    Id {
        /// The `next_id` of the header.
        next_id: u64,
    },
    /// Revisions that the header excludes, or that contradict each other.
    #[error(
        "stored by revision {stored} and modified by {modified}, where 1 ≤ stored ≤ modified ≤ {revision}, the \
         snapshot's revision"
    )]
    Revisions {
        /// The revision that stored its state.
        stored: u64,
        /// The revision that last changed it.
        modified: u64,
        /// The revision of the header.
        revision: u64,
    },
    /// A state that is not one of the space.
    #[error("its state is none of the space: {0}")]
    State(StateError),
    /// A state that is not in canonical form, so that no server stored it.
    #[error("its state is not in canonical form")]
    NotCanonical,
    /// A payload above the limit.
    #[error("its payload has {bytes} bytes, and a payload has at most {MAX_PAYLOAD_BYTES}")]
    Payload {
        /// Its size in bytes.
        bytes: usize,
    },
}

/// A problem with a writer session.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
pub enum SessionProblem {
    /// The ids do not ascend.
    #[error("it follows session {before}, and sessions ascend")]
    NotAscending {
        /// The session before.
        before: u64,
    },
    /// No revision of the snapshot opened it.
    #[error("a session is the number of a revision, from 1 to {revision}, the snapshot's")]
    Id {
        /// The revision of the header.
        revision: u64,
    },
    /// A fingerprint that is not a SHA-256.
    #[error("its fingerprint has {bytes} bytes, where a SHA-256 has 32")]
    Fingerprint {
        /// The number of bytes.
        bytes: usize,
    },
    /// A response that does not decode.
    #[error("its response is not a WriteResponse")]
    Response,
}

/// A problem with a block of reserved ids.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
pub enum BlockProblem {
    /// It holds no id.
    #[error("it holds no id")]
    Empty,
    /// It overlaps the block before, or the blocks do not ascend.
    #[error("the block before ends before id {end}, and blocks ascend without an overlap")]
    Overlap {
        /// The id after the block before.
        end: u64,
    },
    /// Ids that the header excludes.
    #[error("reserved ids are below next_id, which is {next_id}")]
    Id {
        /// The `next_id` of the header.
        next_id: u64,
    },
    /// The session is not in the snapshot.
    #[error("session {session} reserved it, and the snapshot has no such session")]
    UnknownSession {
        /// The session.
        session: u64,
    },
}

impl SnapshotError {
    /// The kind of problem in UPPER_SNAKE_CASE.
    pub fn reason(&self) -> &'static str {
        match self {
            SnapshotError::Io(_) => "SNAPSHOT_UNREADABLE",
            SnapshotError::NotSnapshot => "NOT_A_SNAPSHOT",
            SnapshotError::Version { .. } => "SNAPSHOT_VERSION",
            SnapshotError::CutShort { .. } => "SNAPSHOT_CUT_SHORT",
            SnapshotError::Trailing { .. } => "SNAPSHOT_TRAILING",
            SnapshotError::Order { .. } => "SNAPSHOT_ORDER",
            SnapshotError::Damaged { .. } => "SNAPSHOT_DAMAGED",
            SnapshotError::TooLarge { .. }
            | SnapshotError::Malformed { .. }
            | SnapshotError::Space { .. }
            | SnapshotError::Column { .. }
            | SnapshotError::Point { .. }
            | SnapshotError::Session { .. }
            | SnapshotError::Block { .. }
            | SnapshotError::Count { .. } => "SNAPSHOT_INVALID",
        }
    }

    pub(super) fn malformed(part: u64, problem: impl ToString) -> SnapshotError {
        let problem = problem.to_string();
        SnapshotError::Malformed { part, problem }
    }

    pub(super) fn version(found: impl ToString) -> SnapshotError {
        let found = found.to_string();
        SnapshotError::Version { found }
    }

    pub(super) fn next_id(part: u64, found: u64) -> SnapshotError {
        let problem = format!("next_id is {found}, and at most {END_OF_IDS}");
        SnapshotError::Malformed { part, problem }
    }
}

impl From<io::Error> for SnapshotError {
    fn from(error: io::Error) -> SnapshotError {
        SnapshotError::Io(error)
    }
}
