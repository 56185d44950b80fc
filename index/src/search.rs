//! What can be asked of a structure, and the state of one search under way.

use std::{collections::HashSet, time::Instant};

use crate::{
    Kernels, Neighbor, PointRef, Points, Space,
    kernel::{BLOCK, CHILDREN, Scale},
    neighbor::Collector,
};

/// Limits a search to some of the points. The default admits every point.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Filter {
    /// Only points with `tag & tag_mask == tag_value`.
    pub tag_mask: u64,
    /// See `tag_mask`.
    pub tag_value: u64,
    /// Only points whose state was stored after this revision.
    pub since_revision: u64,
}

impl Filter {
    /// Whether a point passes.
    pub fn admits(&self, tag: u64, revision: u64) -> bool {
        tag & self.tag_mask == self.tag_value
            && (self.since_revision == 0 || revision > self.since_revision)
    }
}

/// A question about one state: the `k` nearest points, those within a closed radius, or both at once.
#[derive(Clone, Copy, Debug)]
pub struct Search<'a> {
    /// At most so many neighbours; `usize::MAX` for no limit.
    pub k: usize,
    /// Only points at this distance or nearer; infinity for no limit.
    pub radius: f64,
    /// Answers may be farther than the true ones by a factor of `1 + epsilon`; 0 is exact.
    pub epsilon: f64,
    /// Visits at most so many leaves; `usize::MAX` for as many as exactness needs. (New points of a forest, up to the
    /// next merge, lie in leaves of their own, of any size.)
    pub max_leaves: usize,
    /// Gives up at this time, within some dozens of leaves, with what it has found until then.
    pub until: Option<Instant>,
    /// Only some of the points.
    pub filter: Filter,
    /// Leaves these ids out.
    pub excluded: Option<&'a HashSet<u64>>,
}

impl Search<'_> {
    /// The `k` nearest points.
    pub fn nearest_k(k: usize) -> Self {
        Self {
            k,
            radius: f64::INFINITY,
            epsilon: 0.0,
            max_leaves: usize::MAX,
            until: None,
            filter: Filter::default(),
            excluded: None,
        }
    }

    /// All points at distance `radius` or nearer.
    pub fn nearest_r(radius: f64) -> Self {
        Self {
            radius,
            ..Self::nearest_k(usize::MAX)
        }
    }
}

/// What a search found.
#[derive(Clone, Debug, PartialEq)]
pub struct Answer {
    /// The neighbours, in the order (distance, id).
    pub neighbors: Vec<Neighbor>,
    /// Whether they equal brute force: false only where `epsilon`, `max_leaves` or `until` made the search skip a cell
    /// that might have held one of them.
    pub exact: bool,
}

/// How many leaves are visited between two looks at the clock, each of which takes about a tenth of a leaf's time.
const LEAVES_A_LOOK: u32 = 32;

/// One search under way, carried through every tree and table that takes part in it.
pub(crate) struct Walk<'a> {
    space: &'a Space,
    kernels: &'a Kernels,
    state: &'a [f64],
    search: &'a Search<'a>,
    nearest: Collector,
    scale: Scale,
    /// Keys above this lie farther than what is held ...
    limit: f64,
    /// ... and above this so far that `epsilon` gives them up.
    relaxed_limit: f64,
    leaves_left: usize,
    leaves_entered: u32,
    exact: bool,
    /// Room for a row.
    row: Vec<f64>,
}

impl<'a> Walk<'a> {
    pub(crate) fn new(
        space: &'a Space,
        kernels: &'a Kernels,
        state: &'a [f64],
        search: &'a Search<'a>,
    ) -> Self {
        let mut walk = Self {
            space,
            kernels,
            state,
            search,
            nearest: Collector::new(search.k, search.radius),
            scale: Scale::new(space),
            limit: 0.0,
            relaxed_limit: 0.0,
            leaves_left: search.max_leaves,
            leaves_entered: 0,
            exact: true,
            row: vec![0.0; space.coordinates()],
        };
        walk.tighten();
        walk
    }

    /// The revision after which a point's state must have been stored.
    pub(crate) fn since_revision(&self) -> u64 {
        self.search.filter.since_revision
    }

    /// Measures a point, unless it is surely too far, and keeps it if it passes the filter and is near enough.
    pub(crate) fn consider(&mut self, point: PointRef<'_>) {
        if !self
            .space
            .is_beyond(self.state, point.row, self.nearest.worst())
        {
            self.measure(point);
        }
    }

    /// Measures a point, and keeps it if it passes the filter and is near enough.
    pub(crate) fn measure(&mut self, point: PointRef<'_>) {
        if !self.search.filter.admits(point.tag, point.revision) {
            return;
        }
        let distance = self.space.distance(self.state, point.row);
        self.offer(distance, || point.id);
    }

    /// Measures the point that stands in a slot of `points` and in a lane of a block, where it has this key, as
    /// [`Walk::measure`]: whatever can be is read from the block, which is at hand.
    #[inline]
    pub(crate) fn measure_in_block(
        &mut self,
        points: &Points,
        slot: usize,
        columns: &[f64],
        lane: usize,
        key: f64,
    ) {
        let filter = &self.search.filter;
        if *filter != Filter::default() && !filter.admits(points.tag(slot), points.revision(slot)) {
            return;
        }
        let distance = self.scale.distance(key).unwrap_or_else(|| {
            for (x, &y) in self
                .row
                .iter_mut()
                .zip(columns[lane..].iter().step_by(BLOCK))
            {
                *x = y;
            }
            self.space.distance(self.state, &self.row)
        });
        self.offer(distance, || points.id(slot));
    }

    /// Keeps what is at this distance, if it is near enough.
    fn offer(&mut self, distance: f64, id: impl FnOnce() -> u64) {
        if distance > self.nearest.worst() {
            return;
        }
        let id = id();
        if self.search.excluded.is_some_and(|ids| ids.contains(&id)) {
            return;
        }
        if self.nearest.offer(Neighbor { distance, id }) {
            self.tighten();
        }
    }

    /// Sets the limits by the worst distance that is held.
    fn tighten(&mut self) {
        let worst = self.nearest.worst();
        self.limit = self.scale.limit(worst);
        self.relaxed_limit = if self.search.epsilon > 0.0 {
            self.scale.limit(worst / (1.0 + self.search.epsilon))
        } else {
            self.limit
        };
    }

    /// The keys of a node's boxes, and the bits of those that are within reach.
    #[inline]
    pub(crate) fn bound_boxes(&self, boxes: &[f64], keys: &mut [f64; CHILDREN]) -> u32 {
        (self.kernels.boxes)(self.space, self.state, boxes, self.limit, keys)
    }

    /// The keys of a block's points, and the bits of those that are within reach.
    #[inline]
    pub(crate) fn bound_points(&self, columns: &[f64], keys: &mut [f64; BLOCK]) -> u32 {
        (self.kernels.points)(self.space, self.state, columns, self.limit, keys)
    }

    /// Whether what has this key, or more, may still matter. What may be *at* the worst distance does: a point may win
    /// by its id.
    #[inline]
    pub(crate) fn reaches(&self, key: f64) -> bool {
        key <= self.limit
    }

    /// Whether a box of this key is to be skipped.
    #[inline]
    pub(crate) fn skips(&mut self, key: f64) -> bool {
        if !self.reaches(key) {
            return true;
        }
        if self.leaves_left == 0 || key > self.relaxed_limit {
            self.exact = false;
            return true;
        }
        false
    }

    /// Counts a leaf about to be visited; false if the search has visited as many as it may.
    pub(crate) fn enters_leaf(&mut self) -> bool {
        if self.leaves_left == 0 {
            self.exact = false;
            return false;
        }
        self.leaves_left -= 1;
        if let Some(until) = self.search.until {
            self.leaves_entered += 1;
            if self.leaves_entered.is_multiple_of(LEAVES_A_LOOK) && Instant::now() >= until {
                self.leaves_left = 0;
            }
        }
        true
    }

    pub(crate) fn finish(self) -> Answer {
        Answer {
            neighbors: self.nearest.into_sorted(),
            exact: self.exact,
        }
    }
}
