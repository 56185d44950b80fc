//! The keys and values of the store. Numbers in keys are big-endian, so that keys sort like the numbers; numbers in
//! values are little-endian. Every value ends with a checksum ([`seal`]), except a record, which has a digest.
//!
//! | key | value |
//! |---|---|
//! | `e`, index | [`StagedEntry`]: its [`Stage`], its uid, its name, its content as text |
//! | `h`, index | [`Head`]: revision, next id, newest trimmed revision, newest digest, [`Sum`] of the points |
//! | `p`, index, id | the point: see [`point`](super::point) |
//! | `r`, index, revision | the record, as [`Record`](crate::log::Record) documents it |
//! | `o`, index, revision | a second copy of the record's operation, which has its own retention |
//! | `s`, index, session | the writer session: see [`session`](super::session) |
//! | `b`, index, first id | the block of ids that a session reserved |
//!
//! *index* is a u32, the number of an index in this directory. A number is never used again.
//!
//! All keys are in one keyspace of fjall, for atomicity. fjall moves each keyspace from memory to its files
//! independently, even past the synced part of the journal. With several keyspaces, a crash could leave one ahead of
//! the others, with half a mutation stored.

use std::ops::RangeInclusive;

use xxhash_rust::xxh3::xxh3_64;

use crate::log::{Digest, Entry, Origin, RecordPosition, Uid, cursor::Cursor};

/// The number of an index in keys.
pub(super) type Number = u32;

pub(super) fn entry_key(number: Number) -> [u8; 5] {
    index_key(b'e', number)
}

pub(super) fn head_key(number: Number) -> [u8; 5] {
    index_key(b'h', number)
}

fn index_key(kind: u8, number: Number) -> [u8; 5] {
    let [a, b, c, d] = number.to_be_bytes();
    [kind, a, b, c, d]
}

/// The number of the index in the key of an entry; None for any other key.
pub(super) fn number_of_entry(key: &[u8]) -> Option<Number> {
    match key {
        &[b'e', a, b, c, d] => Some(Number::from_be_bytes([a, b, c, d])),
        _ => None,
    }
}

pub(super) fn record_key(number: Number, revision: u64) -> [u8; 13] {
    key(b'r', number, revision)
}

pub(super) fn operation_key(number: Number, revision: u64) -> [u8; 13] {
    key(b'o', number, revision)
}

pub(super) fn session_key(number: Number, session: u64) -> [u8; 13] {
    key(b's', number, session)
}

pub(super) fn block_key(number: Number, first: u64) -> [u8; 13] {
    key(b'b', number, first)
}

/// The keys of all points of an index.
pub(super) fn point_keys(number: Number) -> RangeInclusive<[u8; 13]> {
    point_key(number, 0)..=point_key(number, u64::MAX)
}

pub(super) fn point_key(number: Number, id: u64) -> [u8; 13] {
    key(b'p', number, id)
}

fn key(kind: u8, number: Number, of: u64) -> [u8; 13] {
    let mut key = [kind; 13];
    key[1..5].copy_from_slice(&number.to_be_bytes());
    key[5..].copy_from_slice(&of.to_be_bytes());
    key
}

/// The id in the key of a point, or the revision in the key of a record or an operation.
pub(super) fn last_of(key: &[u8]) -> Option<u64> {
    let (_, id) = key.split_last_chunk()?;
    Some(u64::from_be_bytes(*id))
}

/// Appends to a value a checksum over its key and itself, so that it cannot pass as the value of another key.
pub(super) fn seal(key: &[u8], mut value: Vec<u8>) -> Vec<u8> {
    let sum = checksum(key, &value);
    value.extend_from_slice(&sum);
    value
}

/// The value without its checksum; None if the checksum does not match.
pub(super) fn unseal<'a>(key: &[u8], sealed: &'a [u8]) -> Option<&'a [u8]> {
    let (value, sum) = sealed.split_last_chunk()?;
    (checksum(key, value) == *sum).then_some(value)
}

fn checksum(key: &[u8], value: &[u8]) -> [u8; 8] {
    (xxh3_64(value) ^ xxh3_64(key).rotate_left(1)).to_le_bytes()
}

/// The entry of an index, and its stage.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct StagedEntry {
    pub(super) entry: Entry,
    pub(super) stage: Stage,
}

/// The stage of an index.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Stage {
    /// It exists.
    Whole,
    /// It is deleted, and its remaining keys are being removed.
    Deleted,
    /// An unfinished copy. No caller was told that it exists, so it is treated as deleted.
    Copied,
    /// Only its entry exists: the rest was unreadable when the store was repaired.
    Unreadable,
}

impl StagedEntry {
    pub(super) fn encode(&self, number: Number) -> Vec<u8> {
        let mut value = vec![match self.stage {
            Stage::Whole => 0,
            Stage::Deleted => 1,
            Stage::Copied => 2,
            Stage::Unreadable => 3,
        }];
        value.extend_from_slice(self.entry.uid.as_bytes());
        value.extend_from_slice(&(self.entry.name.len() as u64).to_le_bytes());
        value.extend_from_slice(self.entry.name.as_bytes());
        value.extend_from_slice(self.entry.content().as_bytes());
        seal(&entry_key(number), value)
    }

    pub(super) fn decode(number: Number, value: &[u8]) -> Option<Self> {
        let mut cursor = Cursor::new(unseal(&entry_key(number), value)?);
        let stage = match cursor.array()? {
            [0] => Stage::Whole,
            [1] => Stage::Deleted,
            [2] => Stage::Copied,
            [3] => Stage::Unreadable,
            _ => return None,
        };
        let uid = Uid::from_bytes(cursor.array()?);
        let length = cursor.length()?;
        let name = str::from_utf8(cursor.take(length)?).ok()?.into();
        let content = str::from_utf8(cursor.take(cursor.remaining())?).ok()?;
        let entry = Entry::of(uid, name, content)?;
        Some(Self { entry, stage })
    }
}

/// The number of points, sessions and blocks of an index, and the sum of their checksums. It detects entries that are
/// missing and deleted ones that have reappeared.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Sum {
    count: u64,
    checksums: u64,
}

impl Sum {
    /// Adds an entry in its stored form.
    pub(super) fn add(&mut self, sealed: &[u8]) {
        self.count = self.count.wrapping_add(1);
        self.checksums = self.checksums.wrapping_add(checksum_of(sealed));
    }

    /// Subtracts an entry that was added.
    pub(super) fn subtract(&mut self, sealed: &[u8]) {
        self.count = self.count.wrapping_sub(1);
        self.checksums = self.checksums.wrapping_sub(checksum_of(sealed));
    }
}

/// The checksum at the end of a value; 0 if the value is too short, which no sealed value is.
fn checksum_of(sealed: &[u8]) -> u64 {
    let last = sealed.last_chunk();
    last.map_or(0, |checksum| u64::from_le_bytes(*checksum))
}

/// The head of an index's log.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Head {
    pub(super) revision: u64,
    pub(super) next_id: u64,
    /// The records up to this revision were trimmed.
    pub(super) trimmed: u64,
    /// The digest of the record of `revision`.
    pub(super) digest: Digest,
    /// The sum of the points, sessions and blocks.
    pub(super) sum: Sum,
}

impl Head {
    /// The head of an index that begins at `origin`, with points of this sum.
    pub(super) fn at(origin: &Origin, sum: Sum) -> Self {
        Self {
            revision: origin.revision,
            next_id: origin.next_id,
            trimmed: origin.revision,
            digest: origin.digest,
            sum,
        }
    }

    /// The newest record.
    pub(super) fn position(&self) -> RecordPosition {
        RecordPosition {
            revision: self.revision,
            digest: self.digest,
        }
    }

    pub(super) fn encode(&self, number: Number) -> Vec<u8> {
        let mut value = Vec::with_capacity(80);
        for part in [self.revision, self.next_id, self.trimmed] {
            value.extend_from_slice(&part.to_le_bytes());
        }
        value.extend_from_slice(&self.digest);
        for part in [self.sum.count, self.sum.checksums] {
            value.extend_from_slice(&part.to_le_bytes());
        }
        seal(&head_key(number), value)
    }

    pub(super) fn decode(number: Number, value: &[u8]) -> Option<Self> {
        let mut cursor = Cursor::new(unseal(&head_key(number), value)?);
        let head = Self {
            revision: cursor.u64()?,
            next_id: cursor.u64()?,
            trimmed: cursor.u64()?,
            digest: cursor.array()?,
            sum: Sum {
                count: cursor.u64()?,
                checksums: cursor.u64()?,
            },
        };
        cursor.is_empty().then_some(head)
    }
}

#[cfg(test)]
mod tests {
    use wayfold_proto::v1::PayloadEncoding;

    use super::*;

    #[test]
    fn values_are_read_again_and_only_under_their_own_key() {
        let staged = StagedEntry {
            entry: Entry {
                uid: Uid::unique(),
                name: "arm".into(),
                space: "sum(R3:0.1, SO3:0.15)".parse().unwrap(),
                payload_encoding: PayloadEncoding::WeightedEdges,
            },
            stage: Stage::Copied,
        };
        assert_eq!(
            StagedEntry::decode(7, &staged.encode(7)),
            Some(staged.clone())
        );
        assert_eq!(StagedEntry::decode(8, &staged.encode(7)), None);
        let head = Head {
            revision: 1,
            next_id: 2,
            trimmed: 3,
            digest: [4; 32],
            sum: Sum {
                count: 5,
                checksums: 6,
            },
        };
        assert_eq!(Head::decode(7, &head.encode(7)), Some(head));
        assert_eq!(Head::decode(8, &head.encode(7)), None);
    }
}
