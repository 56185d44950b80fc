//! A bound on a part before it is decoded: an empty payload or session takes two bytes as it is sent, and up to a hundred
//! once it is decoded.

use prost::encoding::{DecodeContext, WireType, decode_key, decode_varint, skip_field};

use super::SnapshotError;

/// The least bytes of a block of ids, the smallest entry that a part may list: its field, its count and its session.
const MIN_ENTRY_BYTES: usize = 13;

/// Refuses the content of a part that lists more payloads, sessions and blocks than as many points, sessions and blocks
/// can be encoded in its bytes.
pub(super) fn check(part: u64, content: &[u8]) -> Result<(), SnapshotError> {
    let mut entries = 0;
    // The numbers of the fields are those of SnapshotContent, SnapshotPoints, Points and SnapshotSessions.
    for (kind, body) in messages(content) {
        entries += match kind {
            2 => messages(body)
                .filter(|(field, _)| *field == 1)
                .flat_map(|(_, points)| messages(points))
                .filter(|(field, _)| *field == 5)
                .count(),
            4 => messages(body).count(),
            _ => 0,
        };
    }
    match entries > content.len() / MIN_ENTRY_BYTES {
        true => {
            let problem = format!("{entries} entries in {} bytes", content.len());
            Err(SnapshotError::malformed(part, problem))
        }
        false => Ok(()),
    }
}

/// The fields with a length, until one is malformed: the decoder refuses that one.
fn messages(mut rest: &[u8]) -> impl Iterator<Item = (u32, &[u8])> {
    std::iter::from_fn(move || {
        loop {
            let (number, wire_type) = decode_key(&mut rest).ok()?;
            if wire_type == WireType::LengthDelimited {
                let length = usize::try_from(decode_varint(&mut rest).ok()?).ok()?;
                let (body, after) = rest.split_at_checked(length)?;
                rest = after;
                return Some((number, body));
            }
            skip_field(wire_type, number, &mut rest, DecodeContext::default()).ok()?;
        }
    })
}
