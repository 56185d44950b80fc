//! What the roadmap keeps of a milestone beside its state: its edges in the payload, its worker and whether it is
//! complete in the tag.
//!
//! A milestone's edges lead to those stored before it: to the k(n) nearest of the n that there were, where the way is
//! free. They are part of the insert that makes it, but for those to milestones that were stored while its worker checked:
//! of these the insert tells, and until the worker has checked them too the milestone is **pending**. Who reads a pending
//! milestone may use every edge it has, as all of them are checked; only edges to its youngest neighbours may be missing.
//! If its worker dies, whoever finds it can complete it: which candidates it has is a matter of states, ids and revisions,
//! which the index keeps.

use bytes::Bytes;

/// The bit of a tag that is set while the milestone is pending.
pub const PENDING: u64 = 1;

/// The tag of a complete milestone of this worker.
pub fn tag(worker: usize) -> u64 {
    (worker as u64) << 1
}

/// The worker by a milestone's tag.
pub fn worker(tag: u64) -> usize {
    (tag >> 1) as usize
}

/// The payload that keeps these edges: the ids, ascending, in eight bytes each, little-endian.
pub fn payload(edges: &[u64]) -> Bytes {
    edges.iter().flat_map(|id| id.to_le_bytes()).collect()
}

/// The edges that a payload keeps; none if it was not written so.
pub fn edges(payload: &[u8]) -> Option<Vec<u64>> {
    let (ids, rest) = payload.as_chunks::<8>();
    let ids = ids.iter().map(|&id| u64::from_le_bytes(id)).collect();
    rest.is_empty().then_some(ids)
}
