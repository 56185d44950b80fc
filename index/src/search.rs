//! What can be asked of a structure, and the state of one search under way.

use std::{collections::HashSet, time::Instant};

use arrayvec::ArrayVec;

use crate::{
    Neighbor, Points, SearchError, Space,
    candidates::{Candidate, Candidates},
    kernel::{self, Asked, BLOCK, CHILDREN, Coding, Scale, Set},
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
    /// Answers may be farther than the true ones by a factor of `1 + epsilon`, and what lies between
    /// `radius / (1 + epsilon)` and the radius may be missing; 0 is exact.
    pub epsilon: f64,
    /// Visits at most so many leaves; `usize::MAX` for as many as exactness needs. (The points of a
    /// large mutation lie in one leaf until they are merged.)
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

    /// Checks that it can be answered for `state` in `space`.
    #[inline]
    pub(crate) fn check(&self, space: &Space, state: &[f64]) -> Result<(), SearchError> {
        space.check_canonical(state)?;
        if self.radius.is_nan() {
            return Err(SearchError::Radius);
        }
        if !(0.0..f64::INFINITY).contains(&self.epsilon) {
            return Err(SearchError::Epsilon(self.epsilon));
        }
        Ok(())
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
const LEAVES_A_LOOK: usize = 32;

/// See [`Walk::found_few`]. Who finds many points must have looked at many.
const FEW: usize = 100;

/// No tree is higher: a static one of as many points as slots can tell, one a leaf, is 8 high, and what grows is sealed
/// before.
pub(crate) const MOST_HEIGHT: usize = 11;

/// A node some of whose children are still to be visited.
struct Open<N> {
    node: N,
    /// The keys of its children, and the bits of those that are left.
    keys: [f64; CHILDREN],
    left: u32,
    /// The nearest of those.
    next: usize,
}

/// The nodes on the way to the cell that is visited, told by `N`, with what is left of them.
pub(crate) struct Ahead<N>(ArrayVec<Open<N>, MOST_HEIGHT>);

impl<N: Copy> Ahead<N> {
    /// No nodes.
    #[inline(always)]
    pub(crate) fn new() -> Self {
        Self(ArrayVec::new())
    }

    /// The node and the child that come after the next, unless something nearer is found meanwhile.
    #[inline(always)]
    pub(crate) fn peek(&self) -> Option<(N, usize)> {
        self.0.last().map(|open| (open.node, open.next))
    }
}

/// A reach so much greater than the key would let in more than a distance takes to compute.
const LOOSE: f64 = 1.001;

/// One search under way, carried through every tree and table that takes part in it.
pub(crate) struct Walk<'a> {
    space: &'a Space,
    state: &'a [f64],
    search: &'a Search<'a>,
    candidates: Candidates<'a>,
    scale: &'a Scale,
    /// Keys above this lie so far that `epsilon` gives them up.
    relaxed_limit: f64,
    /// What part of the limit that is.
    relaxed: f64,
    leaves_left: usize,
    leaves_entered: usize,
    exact: bool,
    /// Room for a row, where keys alone do not tell distances.
    row: Vec<f64>,
}

impl<'a> Walk<'a> {
    /// Of a state of `space`, whose keys `scale` turns into distances.
    #[inline(always)]
    pub(crate) fn new(
        space: &'a Space,
        scale: &'a Scale,
        state: &'a [f64],
        search: &'a Search<'a>,
    ) -> Self {
        let candidates = Candidates::new(search.k, scale.limit(search.radius));
        let relaxed = scale.relaxed(search.epsilon);
        Self {
            space,
            state,
            search,
            relaxed_limit: candidates.limit() * relaxed,
            relaxed,
            candidates,
            scale,
            leaves_left: search.max_leaves,
            leaves_entered: 0,
            exact: true,
            row: Vec::new(),
        }
    }

    /// The revision after which a point's state must have been stored.
    pub(crate) fn since_revision(&self) -> u64 {
        self.search.filter.since_revision
    }

    /// The bits of the points of a block that may matter, of which these are the `codes`. The state is `asked` in their steps
    /// once it has to be.
    #[inline(always)]
    pub(crate) fn may_matter<S: Set>(
        &self,
        coding: &'a Coding,
        asked: &mut Option<Asked<'a>>,
        codes: &[u16],
    ) -> u32 {
        let limit = self.limit();
        if limit == f64::INFINITY {
            return !0;
        }
        let asked = asked.get_or_insert_with(|| Asked::new(coding, self.space, self.state));
        let limit = self.scale.loosened(limit, asked.error());
        kernel::coded::<S>(self.space, asked, codes, limit)
    }

    /// Bounds the points in the first `lanes` of a block, and keeps those that are near enough, `visible`, and pass the
    /// filter. Each stands in a `slot` of the `table`.
    #[inline(always)]
    pub(crate) fn scan<S: Set>(
        &mut self,
        block: &'a [f64],
        lanes: usize,
        table: &impl Table,
        slot: impl Fn(usize) -> usize,
        visible: impl Fn(usize) -> bool,
    ) {
        let (keys, within) = kernel::points::<S>(self.space, self.state, block, self.limit());
        let filter = self.search.filter;
        let mut left = within & !(!0 << lanes);
        while left != 0 {
            // The nearest first: what is near soon makes the rest not worth a look.
            let lane = if left & (left - 1) == 0 {
                left.trailing_zeros() as usize % BLOCK
            } else {
                S::least(&keys, left)
            };
            left &= !(1 << lane);
            let slot = slot(lane);
            if !visible(slot)
                || filter != Filter::default()
                    && !filter.admits(table.tag(slot), table.revision(slot))
            {
                continue;
            }
            let id = table.id(slot);
            if self.search.excluded.is_some_and(|ids| ids.contains(&id)) {
                continue;
            }
            self.keep(keys[lane], id, &block[lane..]);
            if left != 0 {
                left &= S::within(&keys, self.limit());
            }
        }
    }

    /// Puts the children of a node that are among `lanes` and within reach before all that is `ahead`.
    #[inline(always)]
    pub(crate) fn open<S: Set, N: Copy>(
        &self,
        ahead: &mut Ahead<N>,
        boxes: &[f64],
        lanes: u32,
        node: N,
    ) {
        let (keys, within) = kernel::boxes::<S>(self.space, self.state, boxes, self.limit());
        let left = within & lanes;
        if left != 0 {
            let next = S::least(&keys, left);
            ahead.0.push(Open {
                node,
                keys,
                left,
                next,
            });
        }
    }

    /// The next cell to visit, if one is left that may matter: a node and which child of it, its nearest first.
    #[inline(always)]
    pub(crate) fn next<S: Set, N: Copy>(&mut self, ahead: &mut Ahead<N>) -> Option<(N, usize)> {
        while let Some(open) = ahead.0.last_mut() {
            let (node, child) = (open.node, open.next);
            let key = open.keys[child];
            // What may be *at* the worst distance matters: a point may win by its id.
            let is_near = key <= self.limit();
            let is_given_up = self.leaves_left == 0 || key > self.relaxed_limit;
            if is_near && !is_given_up {
                open.left &= !(1 << child);
                if open.left == 0 {
                    ahead.0.pop();
                } else {
                    open.next = S::least(&open.keys, open.left);
                }
                return Some((node, child));
            }
            // Nor do the others matter, which are no nearer.
            self.exact &= !is_near;
            ahead.0.pop();
        }
        None
    }

    /// Keys above this lie farther than what is held.
    #[inline(always)]
    fn limit(&self) -> f64 {
        self.candidates.limit()
    }

    /// Keeps a point that may be an answer.
    #[inline]
    fn keep(&mut self, key: f64, id: u64, lane: &'a [f64]) {
        let mut candidate = Candidate {
            reach: self.scale.reach(key),
            key,
            id,
            lane,
            distance: f64::NAN,
        };
        if candidate.reach > candidate.key * LOOSE {
            self.measure(&mut candidate);
        }
        let mut is_nearer = self.candidates.offer(candidate);
        if self.candidates.is_crowded() {
            is_nearer |= self.thin_out();
        }
        if is_nearer {
            self.relaxed_limit = self.limit() * self.relaxed;
        }
    }

    /// Computes a candidate's distance, which makes its reach as little as it can be.
    fn measure(&mut self, candidate: &mut Candidate<'_>) -> f64 {
        if !candidate.distance.is_nan() {
            return candidate.distance;
        }
        let distance = self.scale.distance(candidate.key).unwrap_or_else(|| {
            // From the block, which was at hand lately.
            self.row.clear();
            let numbers = candidate.lane.iter().step_by(BLOCK);
            self.row.extend(numbers.take(self.state.len()));
            self.space.distance(self.state, &self.row)
        });
        candidate.distance = distance;
        candidate.reach = self.scale.limit(distance);
        distance
    }

    /// Measures all candidates and keeps the nearest; whether that has made the limit smaller.
    #[cold]
    fn thin_out(&mut self) -> bool {
        let mut nearest: Vec<Candidate<'_>> = self.candidates.drain().collect();
        nearest.retain_mut(|candidate| self.measure(candidate) <= self.search.radius);
        nearest.sort_unstable_by(|a, b| a.distance.total_cmp(&b.distance).then(a.id.cmp(&b.id)));
        nearest.truncate(self.search.k);
        let mut is_nearer = false;
        for candidate in nearest {
            is_nearer |= self.candidates.offer(candidate);
        }
        is_nearer
    }

    /// How many leaves were visited.
    pub(crate) fn leaves_entered(&self) -> usize {
        self.leaves_entered
    }

    /// Whether so few neighbours are held that the search should have reached but a part of a tree.
    pub(crate) fn found_few(&self) -> bool {
        self.candidates.len() <= FEW
    }

    /// Whether all points are searched, exactly: then how far that reaches tells what the next such search will need.
    pub(crate) fn is_plain(&self) -> bool {
        let search = self.search;
        search.epsilon == 0.0
            && search.max_leaves == usize::MAX
            && search.filter == Filter::default()
    }

    /// Counts a leaf about to be visited; false if the search has visited as many as it may.
    pub(crate) fn enters_leaf(&mut self) -> bool {
        if self.leaves_left == 0 {
            self.exact = false;
            return false;
        }
        self.leaves_left -= 1;
        self.leaves_entered += 1;
        if let Some(until) = self.search.until
            && self.leaves_entered.is_multiple_of(LEAVES_A_LOOK)
            && Instant::now() >= until
        {
            self.leaves_left = 0;
        }
        true
    }

    /// The answer; by reference, since a copy of all this would take longer than the rest.
    pub(crate) fn finish(&mut self) -> Answer {
        let mut neighbors = Vec::with_capacity(self.candidates.len());
        for mut candidate in self.candidates.drain() {
            let distance = self.measure(&mut candidate);
            if distance <= self.search.radius {
                neighbors.push(Neighbor {
                    distance,
                    id: candidate.id,
                });
            }
        }
        neighbors.sort_unstable();
        neighbors.truncate(self.search.k);
        Answer {
            neighbors,
            exact: self.exact,
        }
    }
}

/// What a search needs to know of a point besides its state, by its slot in whatever stores it.
pub(crate) trait Table {
    fn id(&self, slot: usize) -> u64;
    fn tag(&self, slot: usize) -> u64;
    fn revision(&self, slot: usize) -> u64;
}

impl Table for Points {
    fn id(&self, slot: usize) -> u64 {
        self.id(slot)
    }

    fn tag(&self, slot: usize) -> u64 {
        self.tag(slot)
    }

    fn revision(&self, slot: usize) -> u64 {
        self.revision(slot)
    }
}
