//! The stored form of a vertex in addition to its state: its parent in the payload, its worker in the tag.
//!
//! A worker's writes reach the server in the order of its inserts, a vertex is inserted after its parent was found or
//! inserted, and nothing is ever removed. So at every revision the parent of every vertex exists.

/// The ids of the roots of the tree from the start and of the tree from the goal.
pub const ROOTS: [u64; 2] = [0, 1];

/// The id that a payload keeps in eight bytes, little-endian; None if it has another form.
pub fn parent(payload: &[u8]) -> Option<u64> {
    Some(u64::from_le_bytes(payload.try_into().ok()?))
}
