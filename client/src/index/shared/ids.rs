//! The ids that the server reserved for this process.

use std::{
    collections::{HashSet, VecDeque},
    ops::Range,
};

/// Blocks of reserved ids, which ascend. Each id is given once.
#[derive(Debug, Default)]
pub(super) struct ReservedIds {
    /// The rest of the blocks.
    left: VecDeque<Range<u64>>,
    /// All blocks of the session, to tell its ids from those of others.
    blocks: Vec<Range<u64>>,
    /// Ids above all blocks that the caller gave: the server may reserve a block around them before it has them.
    given: Vec<u64>,
    /// Ids of `left` that the caller gave.
    skipped: HashSet<u64>,
}

impl ReservedIds {
    pub(super) fn add(&mut self, block: Range<u64>) {
        if block.is_empty() {
            return;
        }
        let given = self.given.iter().filter(|id| block.contains(id));
        self.skipped.extend(given);
        // Blocks ascend, so the next one may be around the ids above this one.
        self.given.retain(|id| *id >= block.end);
        self.left.push_back(block.clone());
        self.blocks.push(block);
    }

    /// Forgets all blocks: the session is over.
    pub(super) fn clear(&mut self) {
        *self = ReservedIds::default();
    }

    /// The number of ids that are left.
    pub(super) fn len(&self) -> u64 {
        let left: u64 = self.left.iter().map(|block| block.end - block.start).sum();
        left.saturating_sub(self.skipped.len() as u64)
    }

    /// The next id, above all those before it.
    pub(super) fn next(&mut self) -> Option<u64> {
        loop {
            let block = self.left.front_mut()?;
            let id = block.start;
            block.start += 1;
            if block.is_empty() {
                self.left.pop_front();
            }
            if self.skipped.is_empty() || !self.skipped.remove(&id) {
                return Some(id);
            }
        }
    }

    /// The caller has given an id of its own.
    pub(super) fn give(&mut self, id: u64) {
        self.given.push(id);
    }

    /// True if `id` was reserved for this session.
    pub(super) fn contain(&self, id: u64) -> bool {
        self.blocks.iter().any(|block| block.contains(&id))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_id_that_the_caller_gave_is_not_given_again() {
        let mut ids = ReservedIds::default();
        ids.add(0..2);
        ids.give(11);
        ids.give(50);
        ids.add(10..13);
        assert_eq!(ids.len(), 4);
        let given: Vec<u64> = std::iter::from_fn(|| ids.next()).collect();
        assert_eq!(given, [0, 1, 10, 12]);
        assert!(ids.contain(11) && !ids.contain(50));
        assert_eq!(ids.len(), 0);
    }

    #[test]
    fn an_id_above_a_block_is_not_given_again_in_the_next_block() {
        let mut ids = ReservedIds::default();
        ids.give(21);
        ids.add(10..12);
        ids.add(20..23);
        assert_eq!(ids.len(), 4);
        let given: Vec<u64> = std::iter::from_fn(|| ids.next()).collect();
        assert_eq!(given, [10, 11, 20, 22]);
    }
}
