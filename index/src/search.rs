//! What can be asked of a structure, and the state of one search under way.

use std::{collections::HashSet, time::Instant};

use crate::{Neighbor, PointRef, Space, neighbor::Collector};

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

/// The cell that a descent stands in, and its bound.
#[derive(Default)]
pub(crate) struct Cell {
    pub(crate) lo: Vec<f64>,
    pub(crate) hi: Vec<f64>,
    /// Each axis' weighted squared distance from the state; a rotation's stands at its first axis.
    pub(crate) terms: Vec<f64>,
    /// The sum of the terms of each group.
    pub(crate) sums: Vec<f64>,
}

/// How many leaves are visited between two looks at the clock, each of which takes about a tenth of a leaf's time.
const LEAVES_A_LOOK: u32 = 32;

/// One search under way, carried through every tree and table that takes part in it.
pub(crate) struct Walk<'a> {
    pub(crate) space: &'a Space,
    pub(crate) state: &'a [f64],
    search: &'a Search<'a>,
    nearest: Collector,
    leaves_left: usize,
    leaves_entered: u32,
    exact: bool,
    /// Handed from tree to tree, so that only the first descent allocates.
    pub(crate) cell: Cell,
}

impl<'a> Walk<'a> {
    pub(crate) fn new(space: &'a Space, state: &'a [f64], search: &'a Search<'a>) -> Self {
        Self {
            space,
            state,
            search,
            nearest: Collector::new(search.k, search.radius),
            leaves_left: search.max_leaves,
            leaves_entered: 0,
            exact: true,
            cell: Cell::default(),
        }
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
        if distance > self.nearest.worst() {
            return;
        }
        if self
            .search
            .excluded
            .is_some_and(|ids| ids.contains(&point.id))
        {
            return;
        }
        self.nearest.offer(Neighbor {
            distance,
            id: point.id,
        });
    }

    /// Whether a cell may be skipped whose points are all at `bound` or farther. A cell whose bound equals the worst
    /// distance is visited: a point in it may win by its id. (A NaN, from an overflow, compares false and is visited.)
    pub(crate) fn skips(&mut self, bound: f64) -> bool {
        if bound > self.nearest.worst() {
            return true;
        }
        if self.leaves_left == 0 {
            self.exact = false;
            return true;
        }
        if self.search.epsilon > 0.0 && bound * (1.0 + self.search.epsilon) > self.nearest.worst() {
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
