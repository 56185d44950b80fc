//! The stored form of a milestone in addition to its state: its edges in the payload, its worker and the pending bit in
//! the tag.
//!
//! A milestone's edges lead to earlier milestones: to the k(n) nearest of the n earlier ones, if the motion is free.
//! The insert that makes the milestone contains its edges, except those to milestones that its worker did not know. The
//! index tells these later, and until the worker has checked them too, the milestone is **pending**. Every edge of a
//! pending milestone is free; only edges to its youngest neighbours may be missing. If its worker dies, any other
//! worker can complete it: its candidates follow from the states, ids and revisions in the index.

use bytes::Bytes;

/// The bit of a tag that is set while the milestone is pending.
pub const PENDING: u64 = 1;

/// The tag of a complete milestone of this worker.
pub fn tag(worker: usize) -> u64 {
    (worker as u64) << 1
}

/// The worker of a milestone with this tag.
pub fn worker(tag: u64) -> usize {
    (tag >> 1) as usize
}

/// The payload that keeps these edges: the ids, ascending, in eight bytes each, little-endian.
pub fn payload(edges: &[u64]) -> Bytes {
    edges.iter().flat_map(|id| id.to_le_bytes()).collect()
}

/// The edges that a payload keeps; None if it has another form.
pub fn edges(payload: &[u8]) -> Option<Vec<u64>> {
    let (ids, rest) = payload.as_chunks::<8>();
    let ids = ids.iter().map(|&id| u64::from_le_bytes(id)).collect();
    rest.is_empty().then_some(ids)
}
