//! The stored form of a point: the revision of its state, the revision that last changed it, its tag, the number of its
//! coordinates, the coordinates, and the payload up to the checksum. Its id is in the key.

use bytes::Bytes;
use wayfold_index::PointRef;

use super::layout::{Number, last_of, point_key, seal, unseal};
use crate::log::{LogError, StoredPoint, Uid, cursor::Cursor};

/// The stored form of a point that the revision `modified` last changed.
pub(super) fn encode(
    number: Number,
    point: PointRef<'_>,
    modified: u64,
    payload: &[u8],
) -> Vec<u8> {
    let mut value = Vec::with_capacity(40 + 8 * point.row.len() + payload.len());
    for part in [point.revision, modified, point.tag] {
        value.extend_from_slice(&part.to_le_bytes());
    }
    // A space has at most 256 coordinates.
    value.extend_from_slice(&(point.row.len() as u16).to_le_bytes());
    for coordinate in point.row {
        value.extend_from_slice(&coordinate.to_bits().to_le_bytes());
    }
    value.extend_from_slice(payload);
    seal(&point_key(number, point.id), value)
}

/// The point of a key and its value.
pub(super) fn read_entry(
    number: Number,
    uid: Uid,
    (key, value): (&[u8], &[u8]),
) -> Result<StoredPoint, LogError> {
    let id = last_of(key).ok_or_else(|| LogError::Unreadable {
        uid,
        what: "a key of no known form".into(),
    })?;
    read(number, uid, id, value)
}

/// The point with this id.
pub(super) fn read(
    number: Number,
    uid: Uid,
    id: u64,
    value: &[u8],
) -> Result<StoredPoint, LogError> {
    let damaged = || LogError::damaged_point(uid, id, "it does not match its checksum");
    decode(number, id, value).ok_or_else(damaged)
}

/// Decodes a stored point; None if it is damaged.
pub(super) fn decode(number: Number, id: u64, value: &[u8]) -> Option<StoredPoint> {
    let mut cursor = Cursor::new(unseal(&point_key(number, id), value)?);
    let (revision, modified, tag) = (cursor.u64()?, cursor.u64()?, cursor.u64()?);
    let coordinates = u16::from_le_bytes(cursor.array()?);
    let state = (0..coordinates)
        .map(|_| cursor.f64())
        .collect::<Option<_>>()?;
    let payload = Bytes::copy_from_slice(cursor.take(cursor.remaining())?);
    Some(StoredPoint {
        id,
        revision,
        modified,
        tag,
        state,
        payload,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn stored() -> Vec<u8> {
        let point = PointRef {
            id: 5,
            tag: 3,
            revision: 1,
            row: &[0.5, -0.0],
        };
        encode(4, point, 2, b"grasp")
    }

    #[test]
    fn a_point_is_read_again_and_only_under_its_own_key() {
        let value = stored();
        let point = decode(4, 5, &value).unwrap();
        assert_eq!((point.id, point.revision, point.modified), (5, 1, 2));
        assert_eq!((point.tag, &*point.payload), (3, &b"grasp"[..]));
        let bits = point.state.iter().map(|x| x.to_bits());
        assert!(bits.eq([0.5f64.to_bits(), (-0.0f64).to_bits()]));
        assert_eq!(decode(4, 6, &value), None);
        assert_eq!(decode(3, 5, &value), None);
    }

    #[test]
    fn every_flipped_bit_and_every_cut_is_noticed() {
        let value = stored();
        for bit in 0..8 * value.len() {
            let mut flipped = value.clone();
            flipped[bit / 8] ^= 1 << (bit % 8);
            assert_eq!(decode(4, 5, &flipped), None, "bit {bit}");
        }
        for length in 0..value.len() {
            assert_eq!(decode(4, 5, &value[..length]), None, "{length} bytes");
        }
    }
}
