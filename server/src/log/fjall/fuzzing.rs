//! The entry points of the fuzz targets. They call the decoders of all stored values and bypass the checksums, so that
//! arbitrary bytes reach the decoders. Every decoded value must survive encoding and decoding again.

use sha2::{Digest as _, Sha256};

use super::{
    layout::{Head, StagedEntry, block_key, entry_key, head_key, point_key, seal, session_key},
    point::{self, PointForm},
    session, sync_marks,
};
use crate::log::{Digest, Effects, Operation, Record, Sessions};

/// The length of the text that names the form of a record.
const FORM_BYTES: usize = 16;

/// Decodes bytes as a record: first as given, then as the part after the form's name in a record with a matching
/// digest.
pub fn record(bytes: &[u8]) {
    let _ = Record::decode(bytes);
    let mut stored = Record::new(1, Record::NO_PREVIOUS, 0, Effects::new(0)).encode();
    stored.truncate(FORM_BYTES);
    stored.extend_from_slice(bytes);
    let digest: Digest = Sha256::digest(&stored).into();
    stored.extend_from_slice(&digest);
    if let Ok(record) = Record::decode(&stored) {
        assert_eq!(record.encode(), stored);
        assert!(record.is_intact());
        let effects = record.effects();
        // Recovery makes these calls on every record.
        assert!(effects.bytes() > 0);
        assert_eq!(effects.stored().len(), effects.outcomes().len());
    }
}

/// Decodes bytes as another stored value; the first byte selects its kind.
pub fn value(bytes: &[u8]) {
    let Some((kind, bytes)) = bytes.split_first() else {
        return;
    };
    let (number, id) = (1u32, 2);
    match kind % 7 {
        0 => {
            let stored = seal(&point_key(number, id), bytes.to_vec());
            if let Some(point) = point::decode(number, id, &stored) {
                let form = PointForm {
                    revision: point.revision,
                    modified: point.modified,
                    tag: point.tag,
                    state: &point.state,
                    payload: &point.payload,
                };
                assert_eq!(form.encode(number, id), stored);
            }
        }
        kind @ (5 | 6) => {
            let key = if kind == 5 { session_key } else { block_key }(number, id);
            let stored = seal(&key, bytes.to_vec());
            let mut sessions = Sessions::default();
            if session::add(&mut sessions, &key, &stored).is_some() {
                assert_eq!(sessions.len() + sessions.block_count(), 1);
            }
        }
        1 => {
            let stored = seal(&entry_key(number), bytes.to_vec());
            if let Some(staged) = StagedEntry::decode(number, &stored) {
                assert_eq!(
                    StagedEntry::decode(number, &staged.encode(number)),
                    Some(staged)
                );
            }
        }
        2 => {
            let stored = seal(&head_key(number), bytes.to_vec());
            if let Some(head) = Head::decode(number, &stored) {
                assert_eq!(head.encode(number), stored);
            }
        }
        3 => {
            if let Some(operation) = Operation::decode(bytes) {
                assert_eq!(operation.encode(), bytes);
            }
        }
        _ => {
            let mut stored = bytes.to_vec();
            stored.resize(sync_marks::SLOT_BYTES - 8, 0);
            let stored = seal(&number.to_be_bytes(), stored);
            if let Some(mark) = sync_marks::decode(number, &stored) {
                assert_eq!(
                    sync_marks::decode(number, &sync_marks::encode(number, &mark)),
                    Some(mark)
                );
            }
        }
    }
}
