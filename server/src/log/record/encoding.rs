//! The bytes of a record, as [`Record`](super::Record) documents them: the bytes that its digest covers, which are also
//! the stored bytes.

use std::sync::Arc;

use bytes::Bytes;
use wayfold_index::{PointRef, Space};

use super::{Digest, Record, RunId};
use crate::log::{Batch, Effects, Operation, Outcome, cursor::Cursor};

/// The form of a record without a run and a session's batch. A changed form needs a new text.
const OLD_FORM: &[u8; 16] = b"wayfold record 2";

/// The form of all other records.
const FORM: &[u8; 16] = b"wayfold record 3";

/// Passes the bytes of a record to `take`, part by part.
pub(super) fn write(record: &Record, mut take: impl FnMut(&[u8])) {
    let effects = &record.effects;
    // A record of one point fits.
    let mut part = Vec::with_capacity(512);
    let is_old = record.run == Record::NO_RUN && effects.batch.is_none();
    part.extend_from_slice(if is_old { OLD_FORM } else { FORM });
    part.extend_from_slice(&record.previous);
    part.extend_from_slice(&record.revision.to_le_bytes());
    part.extend_from_slice(&record.time_ms.to_le_bytes());
    if !is_old {
        part.extend_from_slice(&record.run);
    }
    for number in [effects.stored.coordinates(), effects.stored.len()] {
        part.extend_from_slice(&(number as u64).to_le_bytes());
    }
    for (slot, point) in effects.stored.iter().enumerate() {
        for number in [point.id, point.tag, point.revision] {
            part.extend_from_slice(&number.to_le_bytes());
        }
        part.push(match effects.outcomes[slot] {
            Outcome::Inserted => 0,
            Outcome::Replaced => 1,
            Outcome::Updated => 2,
        });
        for coordinate in point.row {
            part.extend_from_slice(&coordinate.to_bits().to_le_bytes());
        }
        let payload = effects
            .payloads
            .get(slot)
            .map_or(&[][..], |payload| payload);
        push_sequence(&mut part, payload);
        take(&part);
        part.clear();
    }
    part.extend_from_slice(&(effects.removed.len() as u64).to_le_bytes());
    for id in &effects.removed {
        part.extend_from_slice(&id.to_le_bytes());
    }
    part.extend_from_slice(&u64::from(effects.operation.is_some()).to_le_bytes());
    if let Some(operation) = &effects.operation {
        push_operation(&mut part, operation);
    }
    if !is_old {
        part.extend_from_slice(&u64::from(effects.batch.is_some()).to_le_bytes());
    }
    if let Some(batch) = &effects.batch {
        push_batch(&mut part, batch);
    }
    take(&part);
}

/// The bytes of the stored form of a record with these effects. A record of the old form takes 24 less.
pub(in crate::log) fn stored_bytes(effects: &Effects) -> usize {
    const NUMBER: usize = size_of::<u64>();
    const DIGEST: usize = size_of::<Digest>();
    // The revision, the time, the width of the rows, and the numbers of points, removed ids, operations and batches.
    const HEAD: usize = FORM.len() + 7 * NUMBER + size_of::<RunId>();
    // The id, the tag, the revision, the outcome, and the length of the payload.
    const POINT: usize = 4 * NUMBER + 1;
    let coordinates = effects.stored.coordinates() * effects.stored.len();
    let payloads: usize = effects.payloads.iter().map(Bytes::len).sum();
    let operation = effects.operation.as_ref().map_or(0, |operation| {
        2 * NUMBER + DIGEST + operation.id.len() + operation.response.len()
    });
    let batch = effects.batch.as_ref().map_or(0, |batch| {
        6 * NUMBER + DIGEST + batch.response.len() + NUMBER * batch.ended.len()
    });
    // The digest of the previous record and the record's own.
    HEAD + 2 * DIGEST
        + POINT * effects.stored.len()
        + NUMBER * coordinates
        + payloads
        + NUMBER * effects.removed.len()
        + operation
        + batch
}

fn push_batch(part: &mut Vec<u8>, batch: &Batch) {
    for number in [
        batch.session,
        batch.number,
        batch.reserved.start,
        batch.reserved.end,
    ] {
        part.extend_from_slice(&number.to_le_bytes());
    }
    part.extend_from_slice(&batch.fingerprint);
    push_sequence(part, &batch.response);
    part.extend_from_slice(&(batch.ended.len() as u64).to_le_bytes());
    for session in &batch.ended {
        part.extend_from_slice(&session.to_le_bytes());
    }
}

fn read_batch(cursor: &mut Cursor<'_>) -> Option<Batch> {
    let mut batch = Batch {
        session: cursor.u64()?,
        number: cursor.u64()?,
        reserved: cursor.u64()?..cursor.u64()?,
        fingerprint: cursor.array()?,
        response: Bytes::copy_from_slice(sequence(cursor)?),
        ended: Vec::new(),
    };
    for _ in 0..cursor.length()? {
        batch.ended.push(cursor.u64()?);
    }
    Some(batch)
}

/// Appends the bytes of an operation.
pub(in crate::log) fn push_operation(part: &mut Vec<u8>, operation: &Operation) {
    push_sequence(part, operation.id.as_bytes());
    part.extend_from_slice(&operation.fingerprint);
    push_sequence(part, &operation.response);
}

fn push_sequence(part: &mut Vec<u8>, bytes: &[u8]) {
    part.extend_from_slice(&(bytes.len() as u64).to_le_bytes());
    part.extend_from_slice(bytes);
}

/// Decodes a record from the bytes that `digest` covers; None if they have another form.
pub(super) fn read(bytes: &[u8], digest: Digest) -> Option<Record> {
    let mut cursor = Cursor::new(bytes);
    let form = cursor.array()?;
    let is_old = form == *OLD_FORM;
    if !is_old && form != *FORM {
        return None;
    }
    let (previous, revision, time_ms) = (cursor.array()?, cursor.u64()?, cursor.u64()?);
    let run = match is_old {
        true => Record::NO_RUN,
        false => cursor.array()?,
    };
    let (coordinates, rows) = (cursor.length()?, cursor.length()?);
    // No space is wider. The check applies without rows too, so that later arithmetic on the width cannot overflow.
    if coordinates > Space::MAX_COORDINATES {
        return None;
    }
    let mut effects = Effects::new(coordinates);
    let mut row = Vec::new();
    for _ in 0..rows {
        let (id, tag, stored) = (cursor.u64()?, cursor.u64()?, cursor.u64()?);
        let outcome = match cursor.array()? {
            [0] => Outcome::Inserted,
            [1] => Outcome::Replaced,
            [2] => Outcome::Updated,
            _ => return None,
        };
        row.clear();
        for _ in 0..coordinates {
            row.push(cursor.f64()?);
        }
        let point = PointRef {
            id,
            tag,
            revision: stored,
            row: &row,
        };
        effects.store(
            point,
            outcome,
            Bytes::copy_from_slice(sequence(&mut cursor)?),
        );
    }
    for _ in 0..cursor.length()? {
        effects.remove(cursor.u64()?);
    }
    match cursor.u64()? {
        0 => {}
        1 => effects.set_operation(Some(Arc::new(read_operation(&mut cursor)?))),
        _ => return None,
    }
    match if is_old { 0 } else { cursor.u64()? } {
        0 => {}
        1 => effects.set_batch(Some(Arc::new(read_batch(&mut cursor)?))),
        _ => return None,
    }
    cursor.is_empty().then_some(Record {
        revision,
        previous,
        time_ms,
        run,
        effects,
        digest,
    })
}

/// Reads the operation at the cursor.
pub(in crate::log) fn read_operation(cursor: &mut Cursor<'_>) -> Option<Operation> {
    Some(Operation {
        id: str::from_utf8(sequence(cursor)?).ok()?.to_owned(),
        fingerprint: cursor.array()?,
        response: Bytes::copy_from_slice(sequence(cursor)?),
    })
}

fn sequence<'a>(cursor: &mut Cursor<'a>) -> Option<&'a [u8]> {
    let length = cursor.length()?;
    cursor.take(length)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::log::{
        Record, RecordPosition,
        record::tests::{batch, effects},
    };

    fn with_batch() -> Effects {
        let mut effects = effects();
        effects.set_batch(Some(Arc::new(batch())));
        effects
    }

    #[test]
    fn every_flipped_bit_and_every_cut_is_noticed() {
        let bytes = Record::new(5, [9; 32], 77, with_batch()).encode();
        for bit in 0..8 * bytes.len() {
            let mut flipped = bytes.clone();
            flipped[bit / 8] ^= 1 << (bit % 8);
            assert!(Record::decode(&flipped).is_err(), "bit {bit}");
        }
        for length in 0..bytes.len() {
            assert!(Record::decode(&bytes[..length]).is_err(), "{length} bytes");
        }
    }

    #[test]
    fn the_stored_bytes_are_known_before_the_record_is_made() {
        for effects in [Effects::new(3), effects(), with_batch()] {
            let bytes = stored_bytes(&effects);
            let record = Record::made_by([6; 16], RecordPosition::START, effects);
            assert_eq!(record.encode().len(), bytes);
        }
        let old = Record::after(RecordPosition::START, effects());
        assert_eq!(old.encode().len() + 24, stored_bytes(old.effects()));
    }

    /// Found by fuzzing: recovery counts the bytes of a record, and a huge row width overflowed that count.
    #[test]
    fn rows_wider_than_any_space_are_not_read() {
        let width = |coordinates| {
            let record = Record::new(5, [9; 32], 77, Effects::new(coordinates));
            Record::decode(&record.encode()).map(|record| record.effects().bytes() > 0)
        };
        assert_eq!(width(Space::MAX_COORDINATES), Ok(true));
        for wider in [Space::MAX_COORDINATES + 1, 1 << 32, usize::MAX] {
            assert!(width(wider).is_err(), "{wider} coordinates");
        }
    }
}
