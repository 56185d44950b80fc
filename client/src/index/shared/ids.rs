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
    /// Ids above all blocks that the caller chose, in the order of their writes. Their writes may still be pending when
    /// the server reserves a block that includes them.
    caller_ids: VecDeque<u64>,
    /// Ids of `left` that the caller chose.
    skipped: HashSet<u64>,
}

impl ReservedIds {
    pub(super) fn add(&mut self, block: Range<u64>) {
        if block.is_empty() {
            return;
        }
        let chosen = self.caller_ids.iter().filter(|id| block.contains(id));
        self.skipped.extend(chosen);
        // Blocks ascend, so the next one may be around the ids above this one.
        self.caller_ids.retain(|id| *id >= block.end);
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

    /// Notes an id that the caller chose, after its write.
    pub(super) fn note_caller_id(&mut self, id: u64) {
        self.caller_ids.push_back(id);
    }

    /// Forgets ids that the caller chose and whose writes are published: the server reserves only ids above all that it
    /// has stored. Writes are published in their order, so only the last `unpublished` ids can have others. A batch removes
    /// no id that it stored: the server would count that as never stored.
    pub(super) fn forget_published(&mut self, unpublished: usize) {
        while self.caller_ids.len() > unpublished {
            self.caller_ids.pop_front();
        }
    }

    /// True if `id` was reserved for this session.
    pub(super) fn contains(&self, id: u64) -> bool {
        self.blocks.iter().any(|block| block.contains(&id))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_id_that_the_caller_chose_is_not_given() {
        let mut ids = ReservedIds::default();
        ids.add(0..2);
        ids.note_caller_id(11);
        ids.note_caller_id(50);
        ids.add(10..13);
        assert_eq!(ids.len(), 4);
        let given: Vec<u64> = std::iter::from_fn(|| ids.next()).collect();
        assert_eq!(given, [0, 1, 10, 12]);
        assert!(ids.contains(11) && !ids.contains(50));
        assert_eq!(ids.len(), 0);
    }

    #[test]
    fn an_id_that_the_caller_chose_is_not_given_in_the_next_block() {
        let mut ids = ReservedIds::default();
        ids.note_caller_id(21);
        ids.add(10..12);
        ids.add(20..23);
        assert_eq!(ids.len(), 4);
        let given: Vec<u64> = std::iter::from_fn(|| ids.next()).collect();
        assert_eq!(given, [10, 11, 20, 22]);
    }

    #[test]
    fn only_as_many_ids_of_the_caller_are_remembered_as_writes_are_unpublished() {
        let mut ids = ReservedIds::default();
        for id in 10..1_000 {
            ids.note_caller_id(id);
            ids.forget_published(2);
        }
        assert_eq!(ids.caller_ids, [998, 999]);
        ids.forget_published(0);
        assert!(ids.caller_ids.is_empty());
    }
}
