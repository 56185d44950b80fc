//! The stored form of a vertex in addition to its state: its parent in the payload, its tree and its worker in the tag.
//!
//! Workers choose the ids, each from its own range. So a chain of vertices, each the parent of the next, is one insert,
//! whose payloads are known before it is sent. An insert is applied whole or not at all, its first parent was found in
//! the index, and nothing is ever removed. So at every revision the parent of every vertex exists.

use bytes::Bytes;
use wayfold::Filter;

/// The bit of a tag that gives the tree: 0 from the start, 1 from the goal.
const TREE: u64 = 1;

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

/// The vertices of one tree only.
pub fn of_tree(tree: usize) -> Filter {
    Filter::default().tag(TREE, tree as u64)
}

/// The first id of this worker. It has 2^32 consecutive ids.
pub fn first_id(worker: usize) -> u64 {
    (worker as u64 + 1) << 32
}

/// The payload that keeps an id: eight bytes, little-endian.
pub fn payload(parent: u64) -> Bytes {
    Bytes::copy_from_slice(&parent.to_le_bytes())
}

/// The id that a payload keeps; None if it has another form.
pub fn parent(payload: &[u8]) -> Option<u64> {
    Some(u64::from_le_bytes(payload.try_into().ok()?))
}
