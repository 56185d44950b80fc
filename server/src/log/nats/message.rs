//! A message of a stream: consecutive records of an index.
//!
//! The payload is the records in turn, each as its length (u64, little-endian) and its stored form. The headers name
//! the first and the last revision and the digest of the last record, so that a reader finds its place without payloads.

use std::{str::FromStr, sync::Arc};

use async_nats::{HeaderMap, jetstream::message::StreamMessage};
use bytes::Bytes;

use crate::log::{LogError, Origin, Record, Tip, Uid, cursor::Cursor};

const FIRST: &str = "Wayfold-First";
const LAST: &str = "Wayfold-Last";
const DIGEST: &str = "Wayfold-Digest";

/// A message's place in its stream, and the records in it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Position {
    /// The sequence number in the stream; 0 before the first message of an index.
    pub(super) sequence: u64,
    /// The first revision in it.
    pub(super) first: u64,
    /// The last record in it.
    pub(super) last: Tip,
}

impl Position {
    /// The place before the first message of an index.
    pub(super) const START: Self = Self {
        sequence: 0,
        first: 0,
        last: Tip {
            revision: Origin::START.revision,
            digest: Origin::START.digest,
        },
    };

    /// The position of a stored message.
    pub(super) fn of(uid: Uid, message: &StreamMessage) -> Result<Self, LogError> {
        let read = || {
            Some(Self {
                sequence: message.sequence,
                first: number(&message.headers, FIRST)?,
                last: Tip {
                    revision: number(&message.headers, LAST)?,
                    digest: digest(message.headers.get(DIGEST)?.as_str())?,
                },
            })
        };
        read().ok_or(LogError::Damaged {
            uid,
            revision: 0,
            what: "a message of its stream in NATS was not published by Wayfold",
        })
    }
}

fn number<T: FromStr>(headers: &HeaderMap, name: &str) -> Option<T> {
    headers.get(name)?.as_str().parse().ok()
}

fn digest(text: &str) -> Option<[u8; 32]> {
    let mut digest = [0; 32];
    if text.len() != 64 || !text.is_ascii() {
        return None;
    }
    for (at, byte) in digest.iter_mut().enumerate() {
        *byte = u8::from_str_radix(&text[2 * at..2 * at + 2], 16).ok()?;
    }
    Some(digest)
}

/// The headers of a message with these records; it has one at least.
pub(super) fn headers(first: &Record, last: &Record) -> HeaderMap {
    let digest: String = last
        .digest()
        .iter()
        .map(|byte| format!("{byte:02x}"))
        .collect();
    let mut headers = HeaderMap::new();
    headers.insert(FIRST, first.revision().to_string());
    headers.insert(LAST, last.revision().to_string());
    headers.insert(DIGEST, digest);
    headers
}

/// The bytes that a record takes in a payload, of a stored form of this length.
pub(super) fn packed_bytes(stored: usize) -> usize {
    8 + stored
}

/// Appends a record in its stored form to a payload.
pub(super) fn pack(payload: &mut Vec<u8>, stored: &[u8]) {
    payload.extend_from_slice(&(stored.len() as u64).to_le_bytes());
    payload.extend_from_slice(stored);
}

/// The records of a payload, each intact.
pub(super) fn unpack(uid: Uid, first: u64, payload: &Bytes) -> Result<Vec<Arc<Record>>, LogError> {
    let mut records = Vec::new();
    let mut cursor = Cursor::new(payload);
    while !cursor.is_empty() {
        let damaged = |what| LogError::Damaged {
            uid,
            revision: first + records.len() as u64,
            what,
        };
        let stored = cursor.length().and_then(|length| cursor.take(length));
        let stored = stored.ok_or_else(|| damaged("it is cut short"))?;
        let record = Record::decode(stored).map_err(damaged)?;
        records.push(Arc::new(record));
    }
    Ok(records)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::log::Effects;

    fn records() -> Vec<Record> {
        let first = Record::new(4, [3; 32], 5, Effects::new(2));
        let second = Record::after(first.tip(), Effects::new(2));
        vec![first, second]
    }

    fn payload(records: &[Record]) -> Bytes {
        let mut payload = Vec::new();
        for record in records {
            pack(&mut payload, &record.encode());
        }
        payload.into()
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
        assert_eq!(unpack(uid, 4, &Bytes::new()), Ok(Vec::new()));
    }

    #[test]
    fn every_flipped_bit_and_every_cut_is_noticed() {
        let (uid, records) = (Uid::unique(), records());
        let whole = payload(&records);
        for bit in 0..8 * whole.len() {
            let mut flipped = whole.to_vec();
            flipped[bit / 8] ^= 1 << (bit % 8);
            let found = unpack(uid, 4, &flipped.into());
            assert!(found.is_err(), "bit {bit}");
        }
        let boundary = packed_bytes(records[0].encode().len());
        for length in (1..whole.len()).filter(|length| *length != boundary) {
            let found = unpack(uid, 4, &whole.slice(..length));
            assert!(found.is_err(), "{length} bytes");
        }
    }

    #[test]
    fn headers_name_the_place() {
        let records = records();
        let mut message = StreamMessage {
            subject: "log".into(),
            sequence: 9,
            headers: headers(&records[0], &records[1]),
            payload: Bytes::new(),
            time: std::time::SystemTime::UNIX_EPOCH.into(),
        };
        let uid = Uid::unique();
        let expected = Position {
            sequence: 9,
            first: 4,
            last: records[1].tip(),
        };
        assert_eq!(Position::of(uid, &message), Ok(expected));
        for digest in ["", "zz", "é", &"é".repeat(32), &"0".repeat(63)] {
            message.headers.insert(DIGEST, digest);
            assert!(Position::of(uid, &message).is_err(), "{digest}");
        }
    }
}
