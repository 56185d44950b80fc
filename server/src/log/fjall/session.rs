//! Writer sessions and blocks of reserved ids as the store holds them.
//!
//! | value | bytes |
//! |---|---|
//! | session | the number of its newest batch (u64), the time of its record (u64), the fingerprint, the response |
//! | block | the id after its last one (u64), the session (u64) |

use std::sync::Arc;

use bytes::Bytes;
use fjall::{Keyspace, OwnedWriteBatch};

use super::{
    layout::{Number, Sum, block_key, last_of, seal, session_key, unseal},
    store::{Handles, unreadable},
};
use crate::log::{Block, LogError, Session, Sessions, Uid, cursor::Cursor, session::Change};

/// Adds a change to a batch and to the sum.
pub(super) fn put(
    change: &Change,
    number: Number,
    batch: &mut OwnedWriteBatch,
    keyspace: &Keyspace,
    sum: &mut Sum,
) {
    let (key, values) = match change {
        Change::Session(id, versions) => {
            let key = session_key(number, *id);
            let encode =
                |session: &Option<_>| session.as_deref().map(|it| encode_session(&key, it));
            (key, versions.each_ref().map(encode))
        }
        Change::Block(first, versions) => {
            let key = block_key(number, *first);
            let encode = |block: &Option<_>| block.as_ref().map(|it| encode_block(&key, it));
            (key, versions.each_ref().map(encode))
        }
    };
    let [old, new] = values;
    old.iter().for_each(|old| sum.subtract(old));
    match new {
        Some(new) => {
            sum.add(&new);
            batch.insert(keyspace, key, new);
        }
        None => batch.remove(keyspace, key),
    }
}

/// Adds all entries of a copy to a batch and to the sum.
pub(super) fn put_all(
    sessions: &Sessions,
    number: Number,
    batch: &mut OwnedWriteBatch,
    keyspace: &Keyspace,
    sum: &mut Sum,
) {
    let inserted = |(id, session)| Change::Session(id, [None, Some(Arc::clone(session))]);
    for change in sessions.iter().map(inserted) {
        put(&change, number, batch, keyspace, sum);
    }
    for (first, block) in sessions.blocks() {
        let change = Change::Block(first, [None, Some(block)]);
        put(&change, number, batch, keyspace, sum);
    }
}

/// Reads all sessions and blocks of an index.
pub(super) fn read(handles: &Handles, number: Number, uid: Uid) -> Result<Sessions, LogError> {
    let mut sessions = Sessions::default();
    visit(handles, number, uid, |key, value| {
        add(&mut sessions, key, value)
    })?;
    Ok(sessions)
}

/// Adds all sessions and blocks of an index to the sum. It holds one of them at a time.
pub(super) fn sum_up(
    handles: &Handles,
    number: Number,
    uid: Uid,
    sum: &mut Sum,
) -> Result<(), LogError> {
    visit(handles, number, uid, |key, value| {
        unseal(key, value)?;
        sum.add(value);
        Some(())
    })
}

/// Passes all sessions and blocks of an index to `visit`, which returns None for a damaged one.
fn visit(
    handles: &Handles,
    number: Number,
    uid: Uid,
    mut visit: impl FnMut(&[u8], &[u8]) -> Option<()>,
) -> Result<(), LogError> {
    for keys in [session_key, block_key] {
        for entry in handles
            .keyspace
            .range(keys(number, 0)..=keys(number, u64::MAX))
        {
            let (key, value) = entry.into_inner().map_err(|error| unreadable(uid, error))?;
            visit(&key, &value).ok_or_else(|| LogError::Damaged {
                uid,
                seen: 0,
                what: "a writer session does not match its checksum".into(),
            })?;
        }
    }
    Ok(())
}

/// Adds a stored session or block; None if it is damaged.
pub(super) fn add(sessions: &mut Sessions, key: &[u8], value: &[u8]) -> Option<()> {
    let of = last_of(key)?;
    match key.first()? {
        b's' => sessions.insert(of, decode_session(key, value)?),
        _ => sessions.insert_block(of, decode_block(key, value)?),
    }
    Some(())
}

fn encode_session(key: &[u8], session: &Session) -> Vec<u8> {
    let mut value = Vec::new();
    value.extend_from_slice(&session.batch.to_le_bytes());
    value.extend_from_slice(&session.used_ms.to_le_bytes());
    value.extend_from_slice(&session.fingerprint);
    value.extend_from_slice(&session.response);
    seal(key, value)
}

fn decode_session(key: &[u8], value: &[u8]) -> Option<Session> {
    let mut cursor = Cursor::new(unseal(key, value)?);
    Some(Session {
        batch: cursor.u64()?,
        used_ms: cursor.u64()?,
        fingerprint: cursor.array()?,
        response: Bytes::copy_from_slice(cursor.take(cursor.remaining())?),
    })
}

fn encode_block(key: &[u8], block: &Block) -> Vec<u8> {
    seal(
        key,
        [block.end.to_le_bytes(), block.session.to_le_bytes()].concat(),
    )
}

fn decode_block(key: &[u8], value: &[u8]) -> Option<Block> {
    let mut cursor = Cursor::new(unseal(key, value)?);
    let block = Block {
        end: cursor.u64()?,
        session: cursor.u64()?,
    };
    cursor.is_empty().then_some(block)
}
