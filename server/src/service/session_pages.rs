//! Writer sessions in snapshots: taken part by part, and restored.

use wayfold_proto::v1;

use super::{Error, Limits, check, session::block_count};
use crate::log::{Block, Session, Sessions};

/// Approximate bytes of a session in a snapshot, without its response.
const SESSION_BYTES: usize = 64;

/// Approximate bytes of a block of ids in a snapshot.
const BLOCK_BYTES: usize = 32;

/// Approximate bytes of memory of a session, without its response.
const SESSION_MEMORY_BYTES: usize = 256;

/// Approximate bytes of memory of a block of ids.
const BLOCK_MEMORY_BYTES: usize = 128;

/// The place in an index's sessions up to which a snapshot has them.
#[derive(Default)]
pub(super) struct SessionPages {
    next_session: u64,
    next_block: u64,
}

impl SessionPages {
    /// The next sessions, and the next blocks once there are no more sessions: about `most` bytes. None if there are no
    /// more of either.
    pub(super) fn next(
        &mut self,
        sessions: &Sessions,
        most: usize,
    ) -> Option<v1::SnapshotSessions> {
        let (mut page, mut bytes) = (v1::SnapshotSessions::default(), 0);
        for (id, session) in sessions.iter_from(self.next_session) {
            if bytes >= most {
                return Some(page);
            }
            bytes += SESSION_BYTES + session.response.len();
            page.sessions.push(v1::SnapshotSession {
                session: id,
                batch: session.batch,
                fingerprint: session.fingerprint.to_vec(),
                response: session.response.to_vec(),
                time_ms: session.used_ms,
            });
            self.next_session = id + 1;
        }
        for (first_id, block) in sessions.blocks_from(self.next_block) {
            if bytes >= most {
                break;
            }
            bytes += BLOCK_BYTES;
            page.blocks.push(v1::SnapshotBlock {
                first_id,
                id_count: block.end - first_id,
                session: block.session,
            });
            self.next_block = block.end;
        }
        let is_empty = page.sessions.is_empty() && page.blocks.is_empty();
        (!is_empty).then_some(page)
    }
}

/// The approximate bytes of memory that the sessions and blocks of a snapshot take once they are added.
pub(super) fn memory_bytes(page: &v1::SnapshotSessions) -> u64 {
    let responses = page.sessions.iter().map(|session| session.response.len());
    let sessions = page.sessions.len() * SESSION_MEMORY_BYTES + responses.sum::<usize>();
    (sessions + page.blocks.len() * BLOCK_MEMORY_BYTES) as u64
}

/// Adds the next sessions of a snapshot, which its reader checked; an error if an index may not have as many.
pub(super) fn add_restored(
    sessions: &mut Sessions,
    page: v1::SnapshotSessions,
    limits: &Limits,
) -> Result<(), Error> {
    block_count(sessions.block_count() + page.blocks.len())?;
    let count = sessions.len() + page.sessions.len();
    let advice = "raise it to restore this snapshot";
    check::at_most("max_sessions", limits.max_sessions, count, advice)?;
    for session in page.sessions {
        let fingerprint = session.fingerprint[..].try_into();
        let restored = Session {
            batch: session.batch,
            fingerprint: fingerprint.map_err(|_| Error::Internal {
                what: "a fingerprint without 32 bytes was read".into(),
            })?,
            response: session.response.into(),
            used_ms: session.time_ms,
        };
        sessions.insert(session.session, restored);
    }
    for block in page.blocks {
        let (end, session) = (block.first_id + block.id_count, block.session);
        sessions.insert_block(block.first_id, Block { end, session });
    }
    Ok(())
}
