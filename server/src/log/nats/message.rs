//! The messages of a stream: packs of consecutive records of an index.
//!
//! The bytes of a pack are its records in turn, each as its length (u64, little-endian) and its stored form. A pack is
//! one message, or the messages of one atomic batch if it is larger than a message may be. Headers name the first and
//! the last revision of the pack, the digest of its last record, and the place of the message in the pack, so that a
//! reader finds its place without payloads.

use std::{str::FromStr, sync::Arc};

use async_nats::{HeaderMap, jetstream::message::StreamMessage};

use crate::log::{LogError, Record, RecordPosition, Uid, cursor::Cursor};

const FIRST: &str = "Wayfold-First";
const LAST: &str = "Wayfold-Last";
const DIGEST: &str = "Wayfold-Digest";
/// The number of the message in its pack, from 1, and the number of messages.
const PART: &str = "Wayfold-Part";

/// The most messages of a pack: NATS refuses a larger atomic batch.
const MAX_PARTS: usize = 1000;

const FOREIGN: &str = "a message of its stream in NATS was not published by Wayfold";

/// A message's place in its stream, and the records in it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct PackPosition {
    /// The sequence number in the stream; 0 before the first message of an index.
    pub(super) sequence: u64,
    /// The first revision in it.
    pub(super) first_revision: u64,
    /// The last record in it.
    pub(super) last_record: RecordPosition,
}

impl PackPosition {
    /// The place before the first message of an index.
    pub(super) const START: Self = Self {
        sequence: 0,
        first_revision: 0,
        last_record: RecordPosition::START,
    };

    /// The position of a stored message.
    pub(super) fn of(uid: Uid, message: &StreamMessage) -> Result<Self, LogError> {
        let read = || {
            Some(Self {
                sequence: message.sequence,
                first_revision: number(&message.headers, FIRST)?,
                last_record: RecordPosition {
                    revision: number(&message.headers, LAST)?,
                    digest: digest(message.headers.get(DIGEST)?.as_str())?,
                },
            })
        };
        read().ok_or(LogError::journal_damaged(uid, 0, FOREIGN))
    }
}

fn number<T: FromStr>(headers: &HeaderMap, name: &str) -> Option<T> {
    headers.get(name)?.as_str().parse().ok()
}

fn digest(text: &str) -> Option<[u8; 32]> {
    let mut digest = [0; 32];
    hex::decode_to_slice(text, &mut digest).ok()?;
    Some(digest)
}

/// The headers of a message of a pack from `first` to `last`, by its number and the number of messages.
pub(super) fn headers(first: &Record, last: &Record, part: usize, parts: usize) -> HeaderMap {
    let mut headers = HeaderMap::new();
    headers.insert(FIRST, first.revision().to_string());
    headers.insert(LAST, last.revision().to_string());
    headers.insert(DIGEST, hex::encode(last.digest()));
    headers.insert(PART, format!("{part}/{parts}"));
    headers
}

/// The bytes that a record takes in a payload, of a stored form of this length.
pub(super) fn packed_bytes(stored: usize) -> usize {
    8 + stored
}

/// The number of messages that a pack of these bytes takes.
pub(super) fn part_count(pack: usize, max_payload: usize) -> usize {
    pack.div_ceil(max_payload)
}

/// The bytes of the largest stored form that NATS takes. A larger one than a message is the only one of its pack.
pub(super) fn max_stored_bytes(max_payload: usize) -> usize {
    (MAX_PARTS * max_payload).saturating_sub(packed_bytes(0))
}

/// Appends a record in its stored form to a payload.
pub(super) fn pack(payload: &mut Vec<u8>, stored: &[u8]) {
    payload.extend_from_slice(&(stored.len() as u64).to_le_bytes());
    payload.extend_from_slice(stored);
}

/// The messages of a pack that is not complete yet.
#[derive(Default)]
pub(super) struct Unpacker {
    parts: usize,
    bytes: Vec<u8>,
}

impl Unpacker {
    /// Takes the next message of an index; returns the records of a complete pack, each intact. `next` is the revision
    /// that an error names.
    pub(super) fn take(
        &mut self,
        uid: Uid,
        next: u64,
        headers: &HeaderMap,
        payload: &[u8],
    ) -> Result<Vec<Arc<Record>>, LogError> {
        let damaged = |what| LogError::journal_damaged(uid, next, what);
        let place = headers.get(PART).and_then(|part| {
            let (part, parts) = part.as_str().split_once('/')?;
            Some((part.parse::<usize>().ok()?, parts.parse::<usize>().ok()?))
        });
        let (part, parts) = place.ok_or_else(|| damaged(FOREIGN))?;
        if part == 1 {
            *self = Self::default();
        }
        if part != self.parts + 1 {
            return Err(damaged("a part of it is missing in its stream in NATS"));
        }
        self.parts = part;
        self.bytes.extend_from_slice(payload);
        match part == parts {
            true => unpack(uid, next, &std::mem::take(self).bytes),
            false => Ok(Vec::new()),
        }
    }
}

/// The records of a pack, each intact.
fn unpack(uid: Uid, first: u64, pack: &[u8]) -> Result<Vec<Arc<Record>>, LogError> {
    let mut records = Vec::new();
    let mut cursor = Cursor::new(pack);
    while !cursor.is_empty() {
        let damaged = |what| LogError::journal_damaged(uid, first + records.len() as u64, what);
        let stored = cursor.length().and_then(|length| cursor.take(length));
        let stored = stored.ok_or_else(|| damaged("it is cut short"))?;
        let record = Record::decode(stored).map_err(damaged)?;
        records.push(Arc::new(record));
    }
    Ok(records)
}

#[cfg(test)]
mod tests {
    use bytes::Bytes;

    use super::*;
    use crate::log::Effects;

    fn records() -> Vec<Record> {
        let first = Record::new(4, [3; 32], 5, Effects::new(2));
        let second = Record::after(first.position(), Effects::new(2));
        vec![first, second]
    }

    fn payload(records: &[Record]) -> Vec<u8> {
        let mut payload = Vec::new();
        for record in records {
            pack(&mut payload, &record.encode());
        }
        payload
    }

    #[test]
    fn a_payload_gives_its_records() {
        let uid = Uid::unique();
        let records = records();
        let found = unpack(uid, 4, &payload(&records)).unwrap();
        assert_eq!(
            found,
            records.iter().cloned().map(Arc::new).collect::<Vec<_>>()
        );
        assert_eq!(unpack(uid, 4, &[]), Ok(Vec::new()));
    }

    #[test]
    fn every_flipped_bit_and_every_cut_is_noticed() {
        let (uid, records) = (Uid::unique(), records());
        let whole = payload(&records);
        for bit in 0..8 * whole.len() {
            let mut flipped = whole.clone();
            flipped[bit / 8] ^= 1 << (bit % 8);
            let found = unpack(uid, 4, &flipped);
            assert!(found.is_err(), "bit {bit}");
        }
        let boundary = packed_bytes(records[0].encode().len());
        for length in (1..whole.len()).filter(|length| *length != boundary) {
            let found = unpack(uid, 4, &whole[..length]);
            assert!(found.is_err(), "{length} bytes");
        }
    }

    #[test]
    fn parts_make_a_pack_in_their_order_only() {
        let (uid, records) = (Uid::unique(), records());
        let whole = payload(&records);
        let parts: Vec<_> = whole.chunks(whole.len().div_ceil(3)).collect();
        let take = |unpacker: &mut Unpacker, part: usize| {
            let headers = headers(&records[0], &records[1], part, 3);
            unpacker.take(uid, 4, &headers, parts[part - 1])
        };
        let mut unpacker = Unpacker::default();
        // A reader that begins again gets the first part again.
        for part in [1, 2, 1, 2] {
            assert_eq!(take(&mut unpacker, part), Ok(Vec::new()));
        }
        assert_eq!(take(&mut unpacker, 3).unwrap().len(), 2);
        for part in [2, 3] {
            assert!(take(&mut unpacker, part).is_err());
        }
        assert!(take(&mut unpacker, 1).is_ok() && take(&mut unpacker, 3).is_err());
    }

    #[test]
    fn the_largest_record_fills_the_largest_batch() {
        for max_payload in [276, 64 * 1024 - 1024, 1024 * 1024 - 1024] {
            let parts = |stored| part_count(packed_bytes(stored), max_payload);
            let largest = max_stored_bytes(max_payload);
            assert_eq!(parts(largest), MAX_PARTS);
            assert_eq!(parts(largest + 1), MAX_PARTS + 1);
        }
    }

    #[test]
    fn headers_name_the_place() {
        let records = records();
        let mut message = StreamMessage {
            subject: "log".into(),
            sequence: 9,
            headers: headers(&records[0], &records[1], 1, 1),
            payload: Bytes::new(),
            time: std::time::SystemTime::UNIX_EPOCH.into(),
        };
        let uid = Uid::unique();
        let expected = PackPosition {
            sequence: 9,
            first_revision: 4,
            last_record: records[1].position(),
        };
        assert_eq!(PackPosition::of(uid, &message), Ok(expected));
        for digest in ["", "zz", "é", &"é".repeat(32), &"0".repeat(63)] {
            message.headers.insert(DIGEST, digest);
            assert!(PackPosition::of(uid, &message).is_err(), "{digest}");
        }
    }
}
