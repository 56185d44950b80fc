//! One mutation as the log holds it.

use std::{sync::Arc, time::SystemTime};

use sha2::{Digest as _, Sha256};

use super::{Effects, LogError, RecordPosition, Uid};

mod encoding;

pub(super) use encoding::{push_operation, read_operation, stored_bytes};

/// A SHA-256.
pub type Digest = [u8; 32];

/// A random number of a server's run: two servers that share a journal never make equal records.
pub type RunId = [u8; 16];

/// One mutation at its place in the log: its revision, the time of its append, its effects, and a digest over these and
/// the previous record.
///
/// The digest is the record's checksum and its link in the chain. Numbers are little-endian, and the length of a
/// sequence precedes it as u64. The digest covers, in this order: the text `wayfold record 3`; the digest of the
/// previous record, the revision, the time, the run, and the width of the rows; the stored points, each as id, tag,
/// revision, outcome (a byte: 0 inserted, 1 replaced, 2 updated), the bits of the state, and the payload; the removed
/// ids; the number of operations (0 or 1), and the id, fingerprint and response of each; the number of batches (0 or
/// 1), and for each the session, the batch's number, the first reserved id and the id after the last one, the
/// fingerprint, the response, and the sessions that end. A record without a run and a batch has the text `wayfold
/// record 2`, no run, and no number of batches.
#[derive(Clone, Debug, PartialEq)]
pub struct Record {
    revision: u64,
    previous: Digest,
    time_ms: u64,
    run: RunId,
    effects: Effects,
    digest: Digest,
}

impl Record {
    /// The previous digest that the first record of an index carries.
    pub const NO_PREVIOUS: Digest = [0; 32];

    /// The run of records that name none.
    pub const NO_RUN: RunId = [0; 16];

    /// The next record after `position`, with the current time, made by no named run. Only tests use it.
    pub fn after(position: RecordPosition, effects: Effects) -> Self {
        Self::made_by(Self::NO_RUN, position, effects)
    }

    /// The next record after `position`, with the current time.
    pub fn made_by(run: RunId, position: RecordPosition, effects: Effects) -> Self {
        let time_ms = time_ms(SystemTime::now());
        Self::sealed(
            run,
            position.revision + 1,
            position.digest,
            time_ms,
            effects,
        )
    }

    /// True if it is the next record after `position`.
    pub fn follows(&self, position: RecordPosition) -> bool {
        self.revision == position.revision + 1 && self.previous == position.digest
    }

    /// The record of `revision`, made at `time_ms` by no named run, after the record with the digest `previous`. Only tests
    /// and fuzzing use it.
    pub fn new(revision: u64, previous: Digest, time_ms: u64, effects: Effects) -> Self {
        Self::sealed(Self::NO_RUN, revision, previous, time_ms, effects)
    }

    fn sealed(run: RunId, revision: u64, previous: Digest, time_ms: u64, effects: Effects) -> Self {
        let mut record = Self {
            revision,
            previous,
            time_ms,
            run,
            effects,
            digest: Digest::default(),
        };
        record.digest = record.computed_digest();
        record
    }

    /// Its place in the log.
    pub fn position(&self) -> RecordPosition {
        RecordPosition {
            revision: self.revision,
            digest: self.digest,
        }
    }

    /// The revision that this mutation made.
    pub fn revision(&self) -> u64 {
        self.revision
    }

    /// The digest of the previous record.
    pub fn previous(&self) -> &Digest {
        &self.previous
    }

    /// The time of its append by the machine's clock, in milliseconds since 1970. The clock may be set, so the time may
    /// decrease from record to record.
    pub fn time_ms(&self) -> u64 {
        self.time_ms
    }

    /// Its effects.
    pub fn effects(&self) -> &Effects {
        &self.effects
    }

    /// The checksum of this record.
    pub fn digest(&self) -> &Digest {
        &self.digest
    }

    /// Its stored form: the bytes that the digest covers, then the digest.
    pub(super) fn encode(&self) -> Vec<u8> {
        let mut bytes = Vec::with_capacity(stored_bytes(&self.effects));
        encoding::write(self, |part| bytes.extend_from_slice(part));
        bytes.extend_from_slice(&self.digest);
        bytes
    }

    /// Decodes a stored form, or returns its damage.
    pub(super) fn decode(bytes: &[u8]) -> Result<Self, &'static str> {
        let Some((covered, digest)) = bytes.split_last_chunk() else {
            return Err("it is cut short");
        };
        // The checksum is compared before the bytes are decoded.
        if Digest::from(Sha256::digest(covered)) != *digest {
            return Err("it does not match its checksum");
        }
        encoding::read(covered, *digest).ok_or("it is of no form that this version knows")
    }

    fn computed_digest(&self) -> Digest {
        let mut hash = Sha256::new();
        encoding::write(self, |part| hash.update(part));
        hash.finalize().into()
    }
}

/// The position of the last of these records of an index. Fails unless the first follows `position`, and each other one the
/// record before it.
pub(crate) fn position_after(
    uid: Uid,
    position: RecordPosition,
    records: &[Arc<Record>],
) -> Result<RecordPosition, LogError> {
    let mut position = position;
    for record in records {
        if !record.follows(position) {
            let what = "it does not follow the record before it";
            return Err(LogError::journal_damaged(uid, record.revision(), what));
        }
        position = record.position();
    }
    Ok(position)
}

/// `time` as [`Record::time_ms`] counts it.
pub(super) fn time_ms(time: SystemTime) -> u64 {
    let since = time.duration_since(SystemTime::UNIX_EPOCH);
    since.map_or(0, |since| since.as_millis() as u64)
}

#[cfg(test)]
pub(super) mod tests {
    use bytes::Bytes;
    use wayfold_index::PointRef;

    use super::*;
    use crate::log::{Batch, Operation, Outcome};

    fn point(id: u64) -> PointRef<'static> {
        PointRef {
            id,
            tag: 3,
            revision: 1,
            row: &[0.5, -0.25],
        }
    }

    pub(in crate::log) fn effects() -> Effects {
        let mut effects = Effects::new(2);
        effects.store(point(7), Outcome::Inserted, Bytes::new());
        effects.store(point(8), Outcome::Replaced, Bytes::from_static(b"grasp"));
        effects.remove(9);
        effects.set_operation(Some(Arc::new(Operation {
            id: "op".into(),
            fingerprint: [1; 32],
            response: Bytes::from_static(b"done"),
        })));
        effects
    }

    pub(in crate::log) fn batch() -> Batch {
        Batch {
            session: 3,
            number: 4,
            fingerprint: [2; 32],
            response: Bytes::from_static(b"written"),
            reserved: 20..30,
            ended: vec![1, 2],
        }
    }

    /// The layout as documented, written out by hand.
    #[test]
    fn the_digest_covers_the_documented_bytes() {
        let mut bytes = b"wayfold record 2".to_vec();
        bytes.extend_from_slice(&[9; 32]);
        for number in [5u64, 77, 2, 2] {
            bytes.extend_from_slice(&number.to_le_bytes());
        }
        for (id, outcome, payload) in [(7u64, 0u8, &b""[..]), (8, 1, b"grasp")] {
            for number in [id, 3, 1] {
                bytes.extend_from_slice(&number.to_le_bytes());
            }
            bytes.push(outcome);
            bytes.extend_from_slice(&0.5f64.to_le_bytes());
            bytes.extend_from_slice(&(-0.25f64).to_le_bytes());
            bytes.extend_from_slice(&(payload.len() as u64).to_le_bytes());
            bytes.extend_from_slice(payload);
        }
        for number in [1u64, 9, 1, 2] {
            bytes.extend_from_slice(&number.to_le_bytes());
        }
        bytes.extend_from_slice(b"op");
        bytes.extend_from_slice(&[1; 32]);
        bytes.extend_from_slice(&4u64.to_le_bytes());
        bytes.extend_from_slice(b"done");
        let expected: Digest = Sha256::digest(&bytes).into();
        assert_eq!(*Record::new(5, [9; 32], 77, effects()).digest(), expected);

        // The form of newer records: with a run, and a session's batch.
        bytes[15] = b'3';
        bytes.splice(64..64, [6; 16]);
        for number in [1u64, 3, 4, 20, 30] {
            bytes.extend_from_slice(&number.to_le_bytes());
        }
        bytes.extend_from_slice(&[2; 32]);
        bytes.extend_from_slice(&7u64.to_le_bytes());
        bytes.extend_from_slice(b"written");
        for number in [2u64, 1, 2] {
            bytes.extend_from_slice(&number.to_le_bytes());
        }
        let expected: Digest = Sha256::digest(&bytes).into();
        let mut effects = effects();
        effects.set_batch(Some(Arc::new(batch())));
        let record = Record::sealed([6; 16], 5, [9; 32], 77, effects);
        assert_eq!(*record.digest(), expected);
    }

    #[test]
    fn two_servers_never_make_equal_records() {
        let of = |run| *Record::sealed([run; 16], 5, [9; 32], 77, effects()).digest();
        assert_ne!(of(1), of(2));
    }
}
