//! The ids that the server reserved for this process.

use std::{collections::VecDeque, ops::Range};

/// Blocks of reserved ids, which ascend. Each id is given once.
#[derive(Debug, Default)]
pub(super) struct ReservedIds {
    /// What is left of the blocks.
    left: VecDeque<Range<u64>>,
    /// All blocks of the session, to tell its ids from those of others.
    blocks: Vec<Range<u64>>,
}

impl ReservedIds {
    pub(super) fn add(&mut self, block: Range<u64>) {
        if !block.is_empty() {
            self.left.push_back(block.clone());
            self.blocks.push(block);
        }
    }

    /// Forgets all blocks: the session is over.
    pub(super) fn clear(&mut self) {
        *self = ReservedIds::default();
    }

    /// The number of ids that are left.
    pub(super) fn len(&self) -> u64 {
        self.left.iter().map(|block| block.end - block.start).sum()
    }

    /// The next id, above all those before it.
    pub(super) fn next(&mut self) -> Option<u64> {
        let block = self.left.front_mut()?;
        let id = block.start;
        block.start += 1;
        if block.is_empty() {
            self.left.pop_front();
        }
        Some(id)
    }

    /// True if `id` was reserved for this session.
    pub(super) fn contain(&self, id: u64) -> bool {
        self.blocks.iter().any(|block| block.contains(&id))
    }
}
