//! The indices of a catalogue, and the beginnings of their logs.

use wayfold_index::Space;
use wayfold_proto::v1::PayloadEncoding;

use super::{Digest, LogError, Record, RecordPosition, Uid};

/// The longest name of an index.
pub(crate) const MAX_NAME_BYTES: usize = 63;

/// An index of the catalogue. The registry keeps names unique.
#[derive(Clone, Debug, PartialEq)]
pub struct Entry {
    /// Its uid, which stands for its history.
    pub uid: Uid,
    /// Its name.
    pub name: String,
    /// Its space.
    pub space: Space,
    /// How its payloads hold edges.
    pub payload_encoding: PayloadEncoding,
}

impl Entry {
    /// The text that catalogues keep: the space, and the payload encoding on a second line if one is declared.
    pub(super) fn content(&self) -> String {
        match self.payload_encoding {
            PayloadEncoding::Unspecified => self.space.to_string(),
            declared => format!("{}\n{}", self.space, declared.as_str_name()),
        }
    }

    /// The entry with this [`Entry::content`]; None if this version cannot read it.
    pub(super) fn of(uid: Uid, name: String, content: &str) -> Option<Self> {
        let (space, declared) = match content.split_once('\n') {
            Some((space, declared)) => (space, PayloadEncoding::from_str_name(declared)?),
            None => (content, PayloadEncoding::Unspecified),
        };
        Some(Self {
            uid,
            name,
            space: space.parse().ok()?,
            payload_encoding: declared,
        })
    }
}

/// An index whose data is lost. Only its name and uid are left.
#[derive(Clone, Debug, PartialEq)]
pub struct LostIndex {
    /// Its name.
    pub name: String,
    /// Its uid.
    pub uid: Uid,
    /// The cause.
    pub why: LogError,
}

/// The beginning of an index's log.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Origin {
    /// Its first revision: that of its first points.
    pub revision: u64,
    /// The least id above every id that was ever stored or reserved.
    pub next_id: u64,
    /// The previous digest that its first record carries.
    pub digest: Digest,
}

impl Origin {
    /// The origin of an empty index.
    pub const START: Self = Self {
        revision: 0,
        next_id: 0,
        digest: Record::NO_PREVIOUS,
    };

    /// The record before its first one.
    pub(crate) fn position(&self) -> RecordPosition {
        RecordPosition {
            revision: self.revision,
            digest: self.digest,
        }
    }

    /// Fails if there are more operations than revisions that may have made them.
    pub(super) fn has_room_for(&self, uid: Uid, operations: usize) -> Result<(), LogError> {
        match operations as u64 > self.revision {
            true => Err(LogError::Damaged {
                uid,
                seen: 0,
                what: "a copy of it has more operations than revisions".into(),
            }),
            false => Ok(()),
        }
    }
}
