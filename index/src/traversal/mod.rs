//! One search under way: depth first through the trees of a structure, the nearest child of a node first.

mod tree;

use std::time::Instant;

use arrayvec::ArrayVec;

use crate::{
    Answer, Filter, Neighbor, Search, SearchError, Space,
    candidates::{BoundedCandidates, Candidate, MAX_BOUNDED, MeasuredCandidates},
    kernel::{self, KeyMap},
    lanes::{BLOCK_ROWS, Isa},
    quantize::{self, QuantizedQuery, Quantizer},
    scan_policy::ScanPolicy,
};
use tree::OpenNode;
pub(crate) use tree::{Frontier, Labels, MAX_HEIGHT, Tree};

/// The number of leaves visited between two reads of the clock. A read costs less than a leaf.
pub(crate) const LEAVES_PER_CLOCK_READ: usize = 32;

/// The greatest number of neighbours of a search that a scan policy learns from: a larger answer must read many leaves.
const MAX_OBSERVED_NEIGHBORS: usize = 100;

/// The least number of points in a block that are measured side by side. Fewer cost less one by one.
const MIN_MEASURED_TOGETHER: usize = 3;

/// One search under way, carried through every tree and table that takes part in it.
pub(crate) struct Traversal<'a> {
    space: &'a Space,
    state: &'a [f64],
    search: &'a Search<'a>,
    bounded: BoundedCandidates<'a>,
    /// Takes the place of `bounded` where many neighbours are asked for.
    measured: Option<MeasuredCandidates>,
    key_map: &'a KeyMap,
    /// A point with a greater key is farther than the candidates held.
    limit: f64,
    /// Greater keys are given up for `epsilon`: the limit times `epsilon_factor`.
    epsilon_limit: f64,
    epsilon_factor: f64,
    leaves_visited: usize,
    /// True once the time of the search has passed.
    is_late: bool,
    /// The row or the block of rows being measured, if keys do not determine distances.
    rows: Vec<f64>,
}

impl<'a> Traversal<'a> {
    /// A search around a canonical state of `space`, with the map of its keys.
    #[inline(always)]
    pub(crate) fn new(
        space: &'a Space,
        key_map: &'a KeyMap,
        state: &'a [f64],
        search: &'a Search<'a>,
    ) -> Self {
        let limit = match search.k {
            0 => f64::NEG_INFINITY,
            _ => key_map.limit(search.radius),
        };
        let measured =
            (search.k > MAX_BOUNDED).then(|| MeasuredCandidates::new(search.k, search.radius));
        let epsilon_factor = key_map.epsilon_factor(search.epsilon);
        Self {
            space,
            state,
            search,
            bounded: BoundedCandidates::new(if measured.is_some() { 0 } else { search.k }, limit),
            measured,
            key_map,
            limit,
            epsilon_limit: limit * epsilon_factor,
            epsilon_factor,
            leaves_visited: 0,
            is_late: false,
            rows: Vec::new(),
        }
    }

    /// Searches a tree: by descending, or by a scan where earlier searches had to visit most of its leaves.
    #[inline(always)]
    pub(crate) fn search<I: Isa, T: Tree<'a>>(&mut self, tree: &mut T) {
        let since = self.since_revision();
        if self.is_late || since > 0 && tree.newest() <= since {
            return;
        }
        let policy = tree.scan_policy().filter(|_| self.is_unrestricted());
        if policy.is_some_and(ScanPolicy::next_scans) {
            tree.scan::<I>(self);
            return;
        }
        let visited = self.leaves_visited;
        let (mut frontier, mut next) = (Frontier(ArrayVec::new()), tree.root());
        while let Some(cell) = next {
            tree.visit::<I>(cell, self, &mut frontier);
            let next_child = self.next::<I, _>(&mut frontier);
            next = next_child.map(|(children, child)| tree.child(children, child));
            tree.prefetch(&frontier);
        }
        if let Some(policy) = policy
            && !self.is_late
            && self.candidate_count() <= MAX_OBSERVED_NEIGHBORS
        {
            policy.observe(tree.scan_is_cheaper(self.leaves_visited - visited));
        }
    }

    fn candidate_count(&self) -> usize {
        self.measured
            .as_ref()
            .map_or(self.bounded.len(), MeasuredCandidates::len)
    }

    /// The revision after which a point's state must have been stored.
    pub(crate) fn since_revision(&self) -> u64 {
        self.search.filter.since_revision
    }

    /// True if the search is exact and has no filter, so that the leaves it visits predict those of the next search.
    fn is_unrestricted(&self) -> bool {
        let search = self.search;
        search.epsilon == 0.0 && search.filter == Filter::default()
    }

    /// A bit for each point of a block of codes that may be an answer. `query` is prepared at the first call that needs
    /// it.
    #[inline(always)]
    pub(crate) fn filter_codes<I: Isa>(
        &self,
        quantizer: &'a Quantizer,
        query: &mut Option<QuantizedQuery<'a>>,
        codes: &[u16],
    ) -> u32 {
        let limit = self.limit;
        if limit == f64::INFINITY {
            return !0;
        }
        let query =
            query.get_or_insert_with(|| QuantizedQuery::new(quantizer, self.space, self.state));
        let limit = self.key_map.expanded(limit, query.error());
        quantize::codes::<I>(self.space, query, codes, limit)
    }

    /// Bounds the points in the first `lanes` of a block, and adds the candidates among those that are visible and pass
    /// the filter. `slot` maps a lane to its slot in `labels`.
    #[inline(always)]
    pub(crate) fn scan_block<I: Isa>(
        &mut self,
        block: &'a [f64],
        lanes: usize,
        labels: &impl Labels,
        slot: impl Fn(usize) -> usize,
        is_visible: impl Fn(usize) -> bool,
    ) {
        let (keys, within) = kernel::points::<I>(self.space, self.state, block, self.limit);
        let mut remaining = within & !(!0 << lanes);
        if self.measured.is_some() {
            self.scan_many::<I>(&keys, remaining, block, labels, slot, is_visible);
            return;
        }
        while remaining != 0 {
            // The nearest first: a near candidate rules out the others.
            let lane = if remaining & (remaining - 1) == 0 {
                remaining.trailing_zeros() as usize % BLOCK_ROWS
            } else {
                I::lowest(&keys, remaining)
            };
            remaining &= !(1 << lane);
            let slot = slot(lane);
            if !is_visible(slot) || !self.admits(labels, slot) {
                continue;
            }
            self.add_candidate::<I>(keys[lane], labels.id(slot), &block[lane..]);
            if remaining != 0 {
                remaining &= I::at_most(&keys, self.limit);
            }
        }
    }

    /// Acts like the rest of [`Traversal::scan_block`] where many neighbours are asked for: measures the `remaining`
    /// points and adds those that are visible and pass the filter.
    #[inline(never)]
    fn scan_many<I: Isa>(
        &mut self,
        keys: &[f64; BLOCK_ROWS],
        mut remaining: u32,
        block: &[f64],
        labels: &impl Labels,
        slot: impl Fn(usize) -> usize,
        is_visible: impl Fn(usize) -> bool,
    ) {
        if remaining == 0 {
            return;
        }
        let distances = if self.measures_together(remaining.count_ones() as usize) {
            I::run(kernel::Measurement {
                space: self.space,
                state: self.state,
                columns: block,
            })
        } else {
            [f64::NAN; BLOCK_ROWS]
        };
        while remaining != 0 {
            let lane = remaining.trailing_zeros() as usize % BLOCK_ROWS;
            remaining &= remaining - 1;
            let slot = slot(lane);
            if !is_visible(slot) || !self.admits(labels, slot) {
                continue;
            }
            let mut distance = distances[lane];
            if distance.is_nan() {
                distance = self.distance(keys[lane], &block[lane..]);
            }
            let id = labels.id(slot);
            let measured = self.measured.as_mut();
            let lower = measured.and_then(|measured| measured.offer(Neighbor { distance, id }));
            if let Some(farthest) = lower {
                self.lower_limit(self.key_map.limit(farthest));
                remaining &= I::at_most(keys, self.limit);
            }
        }
    }

    /// True if the search is for points such as the one in this slot.
    #[inline(always)]
    fn admits(&self, labels: &impl Labels, slot: usize) -> bool {
        let filter = self.search.filter;
        (filter == Filter::default() || filter.admits(labels.tag(slot), labels.revision(slot)))
            && !self.search.excludes(labels.id(slot))
    }

    /// Adds a node to the frontier, with its children among `lanes` that are near enough.
    #[inline(always)]
    pub(crate) fn expand<I: Isa, C: Copy>(
        &self,
        frontier: &mut Frontier<C>,
        boxes: &[f64],
        lanes: u32,
        children: C,
    ) {
        let (keys, within) = kernel::boxes::<I>(self.space, self.state, boxes, self.limit);
        let remaining = within & lanes;
        if remaining != 0 {
            let nearest = I::lowest(&keys, remaining);
            frontier.0.push(OpenNode {
                children,
                keys,
                remaining,
                nearest,
            });
        }
    }

    /// The next cell to visit, as one of a node's children, or None if no cell can hold an answer.
    #[inline(always)]
    fn next<I: Isa, C: Copy>(&mut self, frontier: &mut Frontier<C>) -> Option<(C, usize)> {
        while let Some(open) = frontier.0.last_mut() {
            let (children, child) = (open.children, open.nearest);
            let key = open.keys[child];
            // A cell *at* the worst distance is visited: one of its points may win by its id.
            if key <= self.limit && key <= self.epsilon_limit && !self.is_late {
                open.remaining &= !(1 << child);
                if open.remaining == 0 {
                    frontier.0.pop();
                } else {
                    open.nearest = I::lowest(&open.keys, open.remaining);
                }
                return Some((children, child));
            }
            // The other children are no nearer.
            frontier.0.pop();
        }
        None
    }

    /// Lowers the limit, unless it is lower already.
    #[inline]
    fn lower_limit(&mut self, limit: f64) {
        self.limit = self.limit.min(limit);
        self.epsilon_limit = self.limit * self.epsilon_factor;
    }

    #[inline]
    fn add_candidate<I: Isa>(&mut self, key: f64, id: u64, lane: &'a [f64]) {
        let mut is_lower = self.bounded.offer(Candidate {
            upper_bound: self.key_map.upper_bound(key),
            key,
            id,
            lane,
        });
        if self.bounded.is_overfull() {
            is_lower |= self.resolve_candidates::<I>();
        }
        if is_lower {
            self.lower_limit(self.bounded.limit());
        }
    }

    /// True if `points` points of a block cost less to measure side by side than one by one, or by their keys.
    fn measures_together(&self, points: usize) -> bool {
        points >= MIN_MEASURED_TOGETHER && !self.key_map.is_exact()
    }

    /// Takes the candidates and measures them, several side by side. Calls `each` with those within the radius.
    fn measure<I: Isa>(&mut self, mut each: impl FnMut(Neighbor, Candidate<'a>)) {
        let radius = self.search.radius;
        let mut measured = |candidate: &Candidate<'a>, distance: f64| {
            if distance <= radius {
                let id = candidate.id;
                each(Neighbor { distance, id }, *candidate);
            }
        };
        for block in self.bounded.take().chunks(BLOCK_ROWS) {
            if !self.measures_together(block.len()) {
                for candidate in block {
                    measured(candidate, self.distance(candidate.key, candidate.lane));
                }
                continue;
            }
            // Lanes without a candidate are 0, which every factor can measure.
            self.rows.clear();
            self.rows.resize(self.state.len() * BLOCK_ROWS, 0.0);
            for (axis, column) in self.rows.chunks_exact_mut(BLOCK_ROWS).enumerate() {
                for (x, candidate) in column.iter_mut().zip(block) {
                    *x = candidate.lane[axis * BLOCK_ROWS];
                }
            }
            let distances = I::run(kernel::Measurement {
                space: self.space,
                state: self.state,
                columns: &self.rows,
            });
            for (candidate, distance) in block.iter().zip(distances) {
                measured(candidate, distance);
            }
        }
    }

    /// The distance of a point with this key, in a block from its lane on.
    fn distance(&mut self, key: f64, lane: &[f64]) -> f64 {
        self.key_map.distance(key).unwrap_or_else(|| {
            // By indices: `step_by` takes more instructions.
            self.rows.resize(self.state.len(), 0.0);
            for (axis, number) in self.rows.iter_mut().enumerate() {
                *number = lane[axis * BLOCK_ROWS];
            }
            self.space.distance(self.state, &self.rows)
        })
    }

    /// Measures all candidates and keeps the nearest. Returns whether that lowered the limit.
    #[cold]
    fn resolve_candidates<I: Isa>(&mut self) -> bool {
        let before = self.bounded.limit();
        let mut nearest = Vec::new();
        self.measure::<I>(|neighbor, candidate| nearest.push((neighbor, candidate)));
        nearest.sort_unstable_by_key(|(neighbor, _)| neighbor.order());
        for (neighbor, mut candidate) in nearest.into_iter().take(self.search.k) {
            candidate.upper_bound = self.key_map.limit(neighbor.distance);
            self.bounded.offer(candidate);
        }
        self.bounded.limit() < before
    }

    /// Counts a leaf about to be visited; false if the search is out of time.
    pub(crate) fn enter_leaf(&mut self) -> bool {
        if self.is_late {
            return false;
        }
        self.leaves_visited += 1;
        !self.leaves_visited.is_multiple_of(LEAVES_PER_CLOCK_READ) || self.is_in_time()
    }

    /// Reads the clock; false if the search is out of time.
    pub(crate) fn is_in_time(&mut self) -> bool {
        self.is_late = self
            .search
            .until
            .is_some_and(|until| Instant::now() >= until);
        !self.is_late
    }

    /// The number of leaves visited.
    pub(crate) fn leaves_visited(&self) -> usize {
        self.leaves_visited
    }

    /// The answer. (By reference: moving the traversal costs more than the rest of this.)
    pub(crate) fn finish<I: Isa>(&mut self) -> Result<Answer, SearchError> {
        if self.is_late {
            return Err(SearchError::TimedOut);
        }
        if let Some(measured) = &mut self.measured {
            let neighbors = measured.take_sorted();
            return Ok(Answer { neighbors });
        }
        let mut neighbors = Vec::with_capacity(self.bounded.len());
        self.measure::<I>(|neighbor, _| neighbors.push(neighbor));
        neighbors.sort_unstable_by_key(Neighbor::order);
        debug_assert!(neighbors.is_sorted());
        neighbors.truncate(self.search.k);
        Ok(Answer { neighbors })
    }
}
