//! The structures that callers fill.

use std::time::Duration;

use client::{ReadRevision, ScaledRadius, Search};

/// A search. Begin with `wayfold_search_default()`, which finds all points.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct WayfoldSearch {
    /// The most neighbours of a state; 0 is without a limit.
    pub k: u32,
    /// Unless negative, in place of k: the ⌈k_factor · ln n⌉ nearest of n points, at least 1.
    pub k_factor: f64,
    /// Only points at this distance or nearer; infinity is without a limit.
    pub radius: f64,
    /// Unless negative: the radius of PRM*, min(radius, radius_factor · (ln n / n)^(1/d)).
    pub radius_factor: f64,
    /// Only points with tag & tag_mask == tag_value.
    pub tag_mask: u64,
    /// See tag_mask.
    pub tag_value: u64,
    /// Only points that an earlier answer, which read this revision, could not find.
    pub since: u64,
    /// Answers may be farther than the true ones by a factor of 1 + epsilon; 0 is exact.
    pub epsilon: f64,
    /// The longest time of the search in milliseconds; 0 is without a limit. An insert into a remote index ignores it.
    pub timeout_ms: u64,
}

impl WayfoldSearch {
    pub(crate) const ALL: WayfoldSearch = WayfoldSearch {
        k: 0,
        k_factor: -1.0,
        radius: f64::INFINITY,
        radius_factor: -1.0,
        tag_mask: 0,
        tag_value: 0,
        since: 0,
        epsilon: 0.0,
        timeout_ms: 0,
    };

    pub(crate) fn search(&self) -> Search {
        // The search refuses a NaN.
        let is_set = |factor: f64| factor >= 0.0 || factor.is_nan();
        let mut search = match self.k {
            _ if is_set(self.k_factor) => Search::k_factor(self.k_factor),
            0 => Search::within(f64::INFINITY),
            k => Search::k(k),
        };
        if is_set(self.radius_factor) {
            let radius = ScaledRadius::new(self.radius_factor);
            search = search.radius(match self.radius {
                f64::INFINITY => radius,
                max => radius.max(max),
            });
        } else if self.radius != f64::INFINITY {
            search = search.radius(self.radius);
        }
        search = search
            .tag(self.tag_mask, self.tag_value)
            .since(ReadRevision(self.since))
            .epsilon(self.epsilon);
        match self.timeout_ms {
            0 => search,
            timeout => search.timeout(Duration::from_millis(timeout)),
        }
    }
}

/// The id, the tag and the payload of a state to store. Begin with `wayfold_point_default()`.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct WayfoldPoint {
    /// The id, below 2^63; `UINT64_MAX` for one that the index assigns. The insert fails if a point has it.
    ///
    /// A shared index looks in its copy: of two processes that store the same id at once, the later one replaces the
    /// point, and both calls succeed. Ids in a block that the server reserved for another process are refused, which ends
    /// the writes of this one until `wayfold_index_take_unsent`. Choose a range above all assigned ids, well below 2^63,
    /// then store and flush its last id first: the server assigns only greater ids from then on, and the ids below it
    /// stay the caller's.
    pub id: u64,
    /// The tag, whose bits the planner defines.
    pub tag: u64,
    /// The payload; may be null if it has no bytes.
    pub payload: *const u8,
    /// The bytes of the payload.
    pub payload_bytes: usize,
}
