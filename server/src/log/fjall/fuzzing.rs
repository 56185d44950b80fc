//! The entry points of the fuzz targets, which a test calls too. They call the decoders of all stored values and bypass
//! the checksums, so that arbitrary bytes reach the decoders. Every decoded value must survive encoding and decoding again.

use sha2::{Digest as _, Sha256};

use super::{
    layout::{Head, StagedEntry, block_key, entry_key, head_key, point_key, seal, session_key},
    point, session, sync_marks,
};
use crate::log::{Digest, Operation, Record, Sessions};

/// Decodes bytes as a record: first as given, then as the part after the form's name in records of each form with a
/// matching digest.
pub fn record(bytes: &[u8]) {
    let _ = Record::decode(bytes);
    for form in [b"wayfold record 2", b"wayfold record 3"] {
        let mut stored = [form, bytes].concat();
        let digest: Digest = Sha256::digest(&stored).into();
        stored.extend_from_slice(&digest);
        if let Ok(record) = Record::decode(&stored) {
            let encoded = record.encode();
            // A record without a run and a batch is written in the old form.
            if encoded.starts_with(form) {
                assert_eq!(encoded, stored);
            }
            let effects = record.effects();
            // Recovery makes these calls on every record.
            assert!(effects.bytes() > 0);
            assert_eq!(effects.stored().len(), effects.outcomes().len());
        }
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
                let (modified, payload) = (point.modified, &point.payload);
                let encoded = point::encode(number, point.indexed(), modified, payload);
                assert_eq!(encoded, stored);
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

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use proptest::prelude::*;

    use super::*;
    use crate::log::record::tests::{batch, effects};

    proptest! {
        #![proptest_config(crate::testing::cases(256))]

        #[test]
        fn no_bytes_are_too_odd_to_read(
            bytes in prop::collection::vec(any::<u8>(), 0..300),
            at in 16..200usize,
            number: u64,
        ) {
            record(&bytes);
            (0..7).for_each(|kind| value(&[&[kind], &bytes[..]].concat()));
            let mut effects = effects();
            effects.set_batch(Some(Arc::new(batch())));
            let mut changed = Record::new(5, [9; 32], 77, effects).encode();
            changed[at..at + 8].copy_from_slice(&number.to_le_bytes());
            record(&changed[16..changed.len() - 32]);
        }
    }
}
