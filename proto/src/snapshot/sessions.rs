//! Checks the writer sessions of a snapshot, and the blocks of ids that they reserved.

use prost::Message;

use super::{BlockProblem, Header, SessionProblem, SnapshotError};
use crate::v1;

/// The most bytes of an encoded WriteResponse: it holds four numbers and a uid.
const MAX_RESPONSE_BYTES: usize = 256;

/// The checked sessions and blocks of one snapshot so far.
#[derive(Debug, Default)]
pub(super) struct CheckedSessions {
    /// The ids of the sessions, ascending.
    sessions: Vec<u64>,
    blocks: u64,
    /// The id after the last block.
    end: u64,
}

impl CheckedSessions {
    /// True if there was no session. There is no block then.
    pub(super) fn is_empty(&self) -> bool {
        self.sessions.is_empty()
    }

    /// The numbers of sessions and of blocks, each with its name.
    pub(super) fn counts(&self) -> [(&'static str, u64); 2] {
        [
            ("sessions", self.sessions.len() as u64),
            ("blocks", self.blocks),
        ]
    }

    /// Checks that an index as the header describes it may hold these after the ones before.
    pub(super) fn add(
        &mut self,
        part: u64,
        header: &Header,
        message: &v1::SnapshotSessions,
    ) -> Result<(), SnapshotError> {
        let v1::SnapshotSessions { sessions, blocks } = message;
        if sessions.is_empty() && blocks.is_empty() {
            let problem = "sessions without any session or block";
            return Err(SnapshotError::malformed(part, problem));
        }
        if !sessions.is_empty() && self.blocks > 0 {
            let problem = "a session after a block of ids";
            return Err(SnapshotError::malformed(part, problem));
        }
        for session in sessions {
            self.add_session(header, session)
                .map_err(|problem| SnapshotError::Session {
                    part,
                    session: session.session,
                    problem,
                })?;
        }
        for block in blocks {
            self.add_block(header, block)
                .map_err(|problem| SnapshotError::Block {
                    part,
                    first_id: block.first_id,
                    problem,
                })?;
        }
        Ok(())
    }

    fn add_session(
        &mut self,
        header: &Header,
        session: &v1::SnapshotSession,
    ) -> Result<(), SessionProblem> {
        let id = session.session;
        if let Some(&before) = self.sessions.last().filter(|&&before| before >= id) {
            return Err(SessionProblem::NotAscending { before });
        }
        if id == 0 || id > header.revision {
            let revision = header.revision;
            return Err(SessionProblem::Id { revision });
        }
        let bytes = session.fingerprint.len();
        if bytes != 32 {
            return Err(SessionProblem::Fingerprint { bytes });
        }
        // Fields that are not known decode too, whatever their size.
        let decoded = v1::WriteResponse::decode(&session.response[..]);
        if decoded.is_err() || session.response.len() > MAX_RESPONSE_BYTES {
            return Err(SessionProblem::Response);
        }
        self.sessions.push(id);
        Ok(())
    }

    fn add_block(
        &mut self,
        header: &Header,
        block: &v1::SnapshotBlock,
    ) -> Result<(), BlockProblem> {
        let &v1::SnapshotBlock {
            first_id,
            id_count,
            session,
        } = block;
        if id_count == 0 {
            return Err(BlockProblem::Empty);
        }
        if first_id < self.end {
            return Err(BlockProblem::Overlap { end: self.end });
        }
        let end = first_id.checked_add(id_count);
        let Some(end) = end.filter(|&end| end <= header.next_id) else {
            let next_id = header.next_id;
            return Err(BlockProblem::Id { next_id });
        };
        if self.sessions.binary_search(&session).is_err() {
            return Err(BlockProblem::UnknownSession { session });
        }
        self.end = end;
        self.blocks += 1;
        Ok(())
    }
}
