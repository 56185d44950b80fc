//! The stored form of a vertex in addition to its state: its parent in the payload, its tree and its worker in the tag.
//!
//! A worker's writes reach the server in the order of its inserts, a vertex is inserted after its parent was found or
//! inserted, and nothing is ever removed. So at every revision the parent of every vertex exists.

/// The bit of a tag that gives the tree: 0 from the start, 1 from the goal.
pub const TREE: u64 = 1;

/// The ids of the roots of the tree from the start and of the tree from the goal.
pub const ROOTS: [u64; 2] = [0, 1];

/// The tag of a vertex of this tree, made by this worker.
pub fn tag(tree: usize, worker: usize) -> u64 {
    (worker as u64) << 1 | tree as u64
}

/// The tree of a vertex with this tag.
pub fn tree(tag: u64) -> usize {
    (tag & TREE) as usize
}

/// The worker of a vertex with this tag.
pub fn worker(tag: u64) -> usize {
    (tag >> 1) as usize
}

/// The id that a payload keeps in eight bytes, little-endian; None if it has another form.
pub fn parent(payload: &[u8]) -> Option<u64> {
    Some(u64::from_le_bytes(payload.try_into().ok()?))
}
