//! Bounds on requests before they are decoded: a message without content takes two bytes as it is sent, and up to a hundred
//! once it is decoded. A kind of a step takes one, and four.

use prost::encoding::{DecodeContext, decode_key, skip_field};

use crate::service::{Error, Limits};

/// The most bytes of a request on indices, except for the parts of a snapshot: a space may have any number of terms.
pub(crate) const MAX_INDEX_REQUEST_BYTES: usize = 1024 * 1024;

/// The most columns of a request: a client may send each of their values as a field.
const COLUMNS: usize = 4;

/// The field of [`WriteRequest`](wayfold_proto::v1::WriteRequest) with the kinds of its steps, the only column of numbers of
/// which each may take a single byte.
const STEP_KINDS: u32 = 5;

/// A request may have this many fields that are no values of columns.
const OTHER_FIELDS: usize = 64;

/// The advice for a request above it.
pub(crate) const SMALL_SPACE: &str = "a space has at most 256 coordinates, which need less";

/// Refuses an encoded message that has more fields, or kinds of steps, than the columns of a call with as many rows as it may
/// have.
pub(crate) fn check_fields(
    mut message: &[u8],
    is_write: bool,
    limits: &Limits,
) -> Result<(), Error> {
    let rows = limits.max_ids_per_call.max(limits.max_rows_per_call);
    let most = rows.saturating_mul(COLUMNS).saturating_add(OTHER_FIELDS);
    let mut fields = 0;
    // The decoder refuses what is malformed, and reads nothing behind it.
    while let Ok((number, wire_type)) = decode_key(&mut message) {
        let before = message.len();
        if skip_field(wire_type, number, &mut message, DecodeContext::default()).is_err() {
            break;
        }
        fields += match is_write && number == STEP_KINDS {
            true => before - message.len(),
            false => 1,
        };
        if fields > most {
            return Err(Error::LimitExceeded {
                limit: "message_fields",
                value: most as u64,
                requested: fields as u64,
                advice: "send columns packed, or split the rows over several calls",
            });
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use bytes::Bytes;
    use prost::Message;
    use wayfold_proto::v1;

    use super::*;

    fn limits() -> Limits {
        Limits {
            max_rows_per_call: 10,
            max_ids_per_call: 10,
            ..Limits::default()
        }
    }

    #[test]
    fn empty_payloads_are_counted_before_they_are_decoded() {
        let insert = |payloads| v1::InsertRequest {
            payloads: vec![Bytes::new(); payloads],
            ..Default::default()
        };
        let check = |message: &[u8]| check_fields(message, false, &limits());
        let most = 10 * COLUMNS + OTHER_FIELDS;
        check(&insert(most).encode_to_vec()).unwrap();
        let refused = check(&insert(most + 1).encode_to_vec());
        assert!(matches!(
            refused,
            Err(Error::LimitExceeded { value: 104, .. })
        ));
        // They count behind other fields too.
        let write = v1::WriteRequest {
            index_name: "line".into(),
            payloads: insert(most + 1).payloads,
            ..Default::default()
        };
        assert!(check(&write.encode_to_vec()).is_err());
    }

    #[test]
    fn kinds_of_steps_are_counted_before_they_are_decoded() {
        let write = |steps| v1::WriteRequest {
            kinds: vec![v1::StepKind::Remove.into(); steps],
            ..Default::default()
        };
        let check = |steps: usize| check_fields(&write(steps).encode_to_vec(), true, &limits());
        check(10).unwrap();
        check(10 * COLUMNS + OTHER_FIELDS).unwrap_err();
    }
}
