//! Writer sessions: the outcome of each session's newest batch, so that a retry is recognised after any pause, and the
//! blocks of ids that the sessions reserved. Both are sums of the records, like the points.

use std::{collections::HashSet, ops::Range, sync::Arc, time::SystemTime};

use bytes::Bytes;
use rpds::RedBlackTreeMapSync;

use super::{Digest, Record, record::time_ms};

/// The part of a record that says whose batch it is.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Batch {
    /// The session: the revision of the record that opened it.
    pub session: u64,
    /// The number of the batch in its session; 0 opens the session.
    pub number: u64,
    /// The digest of the request.
    pub fingerprint: Digest,
    /// The response to the request and to its retries, encoded.
    pub response: Bytes,
    /// The ids that the session reserves; empty if none. They are above every id that was used or reserved.
    pub reserved: Range<u64>,
    /// The sessions that end here.
    pub ended: Vec<u64>,
}

impl Batch {
    /// The approximate number of bytes that it takes.
    pub(super) fn bytes(&self) -> usize {
        self.response.len() + 8 * self.ended.len() + 128
    }
}

/// A session with the outcome of its newest batch.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Session {
    /// The number of the batch; 0 if the session was only opened.
    pub batch: u64,
    /// The digest of the request.
    pub fingerprint: Digest,
    /// The response to the request.
    pub response: Bytes,
    /// The time of the record, in milliseconds since 1970.
    pub used_ms: u64,
}

/// Consecutive ids that one session reserved.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Block {
    /// The id after the last one.
    pub end: u64,
    /// The session.
    pub session: u64,
}

/// The sessions of an index as of one revision. A clone shares its content.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Sessions {
    by_id: RedBlackTreeMapSync<u64, Arc<Session>>,
    /// By first id.
    blocks: RedBlackTreeMapSync<u64, Block>,
}

/// An entry of [`Sessions`] before and after a record; None if there is none.
#[derive(Debug, PartialEq)]
pub(super) enum Change {
    Session(u64, [Option<Arc<Session>>; 2]),
    Block(u64, [Option<Block>; 2]),
}

impl Sessions {
    /// The session with this id.
    pub fn get(&self, session: u64) -> Option<&Arc<Session>> {
        self.by_id.get(&session)
    }

    /// The number of sessions.
    pub fn len(&self) -> usize {
        self.by_id.size()
    }

    /// True if there is no session.
    pub fn is_empty(&self) -> bool {
        self.by_id.is_empty()
    }

    /// The number of blocks of reserved ids.
    pub fn block_count(&self) -> usize {
        self.blocks.size()
    }

    /// The number of blocks once these sessions have ended.
    pub fn block_count_without(&self, ended: &[u64]) -> usize {
        if ended.is_empty() {
            return self.block_count();
        }
        let ended: HashSet<u64> = ended.iter().copied().collect();
        let blocks = self.blocks();
        blocks
            .filter(|(_, block)| !ended.contains(&block.session))
            .count()
    }

    /// The session that reserved an id.
    pub fn owner(&self, id: u64) -> Option<u64> {
        let (_, block) = self.blocks.range(..=id).next_back()?;
        (id < block.end).then_some(block.session)
    }

    /// All sessions, by id.
    pub fn iter(&self) -> impl Iterator<Item = (u64, &Arc<Session>)> {
        self.iter_from(0)
    }

    /// The sessions from this id on, by id.
    pub fn iter_from(&self, id: u64) -> impl Iterator<Item = (u64, &Arc<Session>)> {
        let sessions = self.by_id.range(id..);
        sessions.map(|(id, session)| (*id, session))
    }

    /// All blocks, each with its first id.
    pub fn blocks(&self) -> impl Iterator<Item = (u64, Block)> {
        self.blocks_from(0)
    }

    /// The blocks whose first id is this one or a higher one, each with its first id.
    pub fn blocks_from(&self, first: u64) -> impl Iterator<Item = (u64, Block)> {
        let blocks = self.blocks.range(first..);
        blocks.map(|(first, block)| (*first, *block))
    }

    /// The sessions whose newest record is older than this time.
    pub fn unused_since(&self, time: SystemTime) -> Vec<u64> {
        let time_ms = time_ms(time);
        let unused = self.iter().filter(|(_, session)| session.used_ms < time_ms);
        unused.map(|(id, _)| id).collect()
    }

    /// Adds a session that is stored.
    pub fn insert(&mut self, id: u64, session: Session) {
        self.by_id.insert_mut(id, Arc::new(session));
    }

    /// Adds a block that is stored.
    pub fn insert_block(&mut self, first: u64, block: Block) {
        self.blocks.insert_mut(first, block);
    }

    /// Applies the next record.
    pub fn apply(&mut self, record: &Record) {
        self.apply_changes(self.changes(record));
    }

    /// Applies the changes of the next record.
    pub(super) fn apply_changes(&mut self, changes: Vec<Change>) {
        for change in changes {
            match change {
                Change::Session(id, [_, Some(session)]) => {
                    self.by_id.insert_mut(id, session);
                }
                Change::Session(id, [_, None]) => {
                    self.by_id.remove_mut(&id);
                }
                Change::Block(first, [_, Some(block)]) => self.insert_block(first, block),
                Change::Block(first, [_, None]) => {
                    self.blocks.remove_mut(&first);
                }
            }
        }
    }

    /// The changes of the next record.
    pub(super) fn changes(&self, record: &Record) -> Vec<Change> {
        let Some(batch) = record.effects().batch() else {
            return Vec::new();
        };
        let session = Arc::new(Session {
            batch: batch.number,
            fingerprint: batch.fingerprint,
            response: batch.response.clone(),
            used_ms: record.time_ms(),
        });
        let before = self.get(batch.session).cloned();
        let mut changes = vec![Change::Session(batch.session, [before, Some(session)])];
        if !batch.reserved.is_empty() {
            changes.push(self.reservation(batch));
        }
        for id in &batch.ended {
            let Some(session) = self.get(*id) else {
                continue;
            };
            changes.push(Change::Session(*id, [Some(Arc::clone(session)), None]));
        }
        if !batch.ended.is_empty() {
            // All sessions of an index may end in one record, and each has blocks.
            let ended: HashSet<u64> = batch.ended.iter().copied().collect();
            let blocks = self.blocks();
            let blocks = blocks.filter(|(_, block)| ended.contains(&block.session));
            changes.extend(blocks.map(|(first, block)| Change::Block(first, [Some(block), None])));
        }
        changes
    }

    /// A block that follows the session's last one extends it: a lone writer has one block, however many ids it
    /// reserves.
    fn reservation(&self, batch: &Batch) -> Change {
        let Range { start, end } = batch.reserved;
        let block = Block {
            end,
            session: batch.session,
        };
        match self.blocks.range(..start).next_back() {
            Some((&first, &last)) if (last.end, last.session) == (start, batch.session) => {
                Change::Block(first, [Some(last), Some(block)])
            }
            _ => Change::Block(start, [None, Some(block)]),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;
    use crate::log::Effects;

    fn record(revision: u64, batch: Batch) -> Record {
        let mut effects = Effects::new(1);
        effects.set_batch(Some(Arc::new(batch)));
        Record::new(revision, Record::NO_PREVIOUS, revision * 10, effects)
    }

    fn batch(session: u64, number: u64, reserved: Range<u64>, ended: &[u64]) -> Batch {
        Batch {
            session,
            number,
            fingerprint: [number as u8; 32],
            response: Bytes::from_static(b"done"),
            reserved,
            ended: ended.to_vec(),
        }
    }

    #[test]
    fn the_newest_outcome_and_every_block_are_kept_until_the_session_ends() {
        let mut sessions = Sessions::default();
        sessions.apply(&record(1, batch(1, 0, 0..10, &[])));
        sessions.apply(&record(2, batch(2, 0, 10..20, &[])));
        sessions.apply(&record(3, batch(1, 1, 20..30, &[])));
        let earlier = sessions.clone();
        sessions.apply(&record(4, batch(1, 2, 30..40, &[])));
        assert_eq!(sessions.get(1).map(|session| session.batch), Some(2));
        assert_eq!(earlier.get(1).map(|session| session.batch), Some(1));
        assert_eq!(sessions.blocks().count(), 3, "adjacent blocks are one");
        let owners = [0, 9, 10, 19, 20, 39, 40].map(|id| sessions.owner(id));
        let expected = [1, 1, 2, 2, 1, 1].map(Some);
        assert_eq!(owners[..6], expected);
        assert_eq!(owners[6], None);

        assert_eq!(
            sessions.unused_since(SystemTime::UNIX_EPOCH + Duration::from_millis(21)),
            [2]
        );
        assert_eq!(sessions.block_count_without(&[2]), 2);
        sessions.apply(&record(5, batch(5, 0, 0..0, &[2])));
        assert_eq!(sessions.block_count(), 2);
        assert_eq!(sessions.get(2), None);
        assert_eq!(sessions.owner(10), None);
        assert_eq!(sessions.len(), 2);
        assert_eq!(earlier.owner(10), Some(2));
    }

    /// A store subtracts the old entry from its sum.
    #[test]
    fn changes_name_what_stood_before() {
        let mut sessions = Sessions::default();
        let opened = record(1, batch(1, 0, 0..10, &[]));
        let extended = record(2, batch(1, 1, 10..12, &[]));
        sessions.apply(&opened);
        let [
            Change::Session(1, [Some(_), Some(_)]),
            Change::Block(0, [Some(old), Some(new)]),
        ] = &sessions.changes(&extended)[..]
        else {
            panic!("{:?}", sessions.changes(&extended));
        };
        assert_eq!((old.end, new.end), (10, 12));
    }
}
