//! The search of an insert: in the copy, and until the server has stored the point.

use wayfold_index::{Filter, Neighbor, ScaledSearch, Scaling, Search, Space};

use super::{KnownPoints, MAX_SUPERSET};
use crate::index::shared::rebased::Content;

/// The insert came after the copy was read the last time.
const AFTER_ALL: u64 = u64::MAX;

/// A search with a scaled number finds as many neighbours as twice the copy's points and this many more would give it. The
/// factor 2e makes that 45 more in an empty copy, and at most five more from 10,000 points on.
const RESERVE_POINTS: usize = 4_096;

/// The search of an insert in the copy. If its number or its radius is scaled, it finds more than the insert answers: both
/// may be greater at the point's place in the order.
#[derive(Clone, Copy, Debug)]
pub(in crate::index::shared) struct InsertSearch<'a> {
    /// The search to make in the copy.
    pub(in crate::index::shared) search: Search<'a>,
    scaling: Scaling,
    /// The number of neighbours that the insert answers.
    k: usize,
    /// The radius of the neighbours that the insert answers.
    radius: f64,
}

impl<'a> InsertSearch<'a> {
    /// The search in a copy of `points` points of a space of this dimension.
    pub(in crate::index::shared) fn new(
        scaled: &ScaledSearch<'a>,
        points: usize,
        dimension: usize,
    ) -> InsertSearch<'a> {
        let scaling = scaled.scaling;
        let mut search = scaled.among(points, dimension);
        let (k, radius) = (search.k, search.radius);
        let reserve = points.saturating_mul(2).saturating_add(RESERVE_POINTS);
        if let Some(reserve_k) = scaling.k(reserve) {
            search.k = reserve_k;
        }
        // The radius of three points is greater than that of two. From three on it shrinks.
        if let Some(next) = scaling.radius(points.saturating_add(1), dimension) {
            search.radius = radius.max(next);
        }
        InsertSearch {
            search,
            scaling,
            k,
            radius,
        }
    }

    /// The number of the neighbours found that the insert answers: the first of them.
    pub(in crate::index::shared) fn answer_len(&self, found: &[Neighbor]) -> usize {
        let within = found.partition_point(|neighbor| neighbor.distance <= self.radius);
        within.min(self.k)
    }
}

#[cfg(test)]
impl<'a> From<Search<'a>> for InsertSearch<'a> {
    /// A search without factors.
    fn from(search: Search<'a>) -> InsertSearch<'a> {
        let scaling = Scaling::default();
        InsertSearch::new(&ScaledSearch { search, scaling }, 0, 1)
    }
}

/// The search of an insert that the server has not stored yet.
#[derive(Clone, Debug)]
pub(in crate::index::shared) struct OpenSearch {
    pub(super) id: u64,
    /// The position of the insert in its batch.
    pub(in crate::index::shared) step: usize,
    pub(super) row: Vec<f64>,
    pub(super) filter: Filter,
    scaling: Scaling,
    /// The number of neighbours that the insert answered at most.
    k: usize,
    /// The number of neighbours that the insert searched for: `k`, or more if the number is scaled.
    reserve_k: usize,
    /// The greatest distance of a neighbour that the insert searched for.
    radius: f64,
    /// The neighbours that the insert found; none if it answered all that the copy had within the radius.
    found: Vec<Neighbor>,
    /// The number of these that the insert answered: the first of them.
    answer_len: usize,
    /// The change that stored the point in the copy.
    pub(super) change: u64,
    /// The number of published points before the insert, once it is published.
    pub(in crate::index::shared) points_before: usize,
    /// The revision of the insert, or [`AFTER_ALL`]; None if the copy was read again, and had it already at one that is not
    /// known.
    pub(in crate::index::shared) revision: Option<u64>,
    /// The first and the last change since by which the copy was read again; `u64::MAX` for none.
    pub(super) first_reload: u64,
    pub(super) last_reload: u64,
    /// True if the copy was read again since, or too many points arrived.
    pub(super) is_superset: bool,
    /// True if too many points arrived.
    pub(super) searches_all: bool,
}

impl OpenSearch {
    /// The search with which the point `id` was inserted by a step of its batch, and what it found: change number
    /// `change` of the copy stored the point.
    pub(in crate::index::shared) fn new(
        (id, step): (u64, usize),
        row: &[f64],
        search: &InsertSearch<'_>,
        found: &[Neighbor],
        change: u64,
    ) -> OpenSearch {
        let answer_len = search.answer_len(found);
        let has_all = found.len() < search.k && answer_len == found.len();
        OpenSearch {
            id,
            step,
            row: row.to_vec(),
            filter: search.search.filter,
            scaling: search.scaling,
            k: search.k,
            reserve_k: search.search.k,
            radius: search.search.radius,
            found: match has_all {
                // The radius is the bound.
                true => Vec::new(),
                false => found.to_vec(),
            },
            answer_len,
            change,
            points_before: 0,
            revision: Some(AFTER_ALL),
            first_reload: u64::MAX,
            last_reload: u64::MAX,
            is_superset: false,
            searches_all: false,
        }
    }

    /// The bytes that it holds until its point is published.
    pub(in crate::index::shared) fn bytes(&self) -> usize {
        size_of::<OpenSearch>() + size_of_val(&self.row[..]) + size_of_val(&self.found[..])
    }

    /// The copy was read again, as change number `change`: the answer will be a superset.
    pub(in crate::index::shared) fn reload(&mut self, change: u64) {
        self.first_reload = self.first_reload.min(change);
        (self.last_reload, self.is_superset) = (change, true);
    }

    /// The answer will be a superset, of all points.
    pub(in crate::index::shared) fn search_all(&mut self) {
        (self.is_superset, self.searches_all) = (true, true);
    }

    /// The content of a point at the place of the insert.
    pub(super) fn content<'a>(
        &self,
        versions: &'a [(usize, Option<Content>)],
    ) -> Option<&'a Content> {
        let mut versions = versions.iter();
        let (_, content) = versions.find(|(step, _)| *step > self.step)?;
        content.as_ref()
    }

    /// True if the search is for points with this tag.
    pub(super) fn passes(&self, tag: u64) -> bool {
        tag & self.filter.tag_mask == self.filter.tag_value
    }

    /// True if a neighbour that the insert found is one still with this tag and row.
    pub(super) fn finds_again(
        &self,
        found: &Neighbor,
        tag: u64,
        row: &[f64],
        space: &Space,
    ) -> bool {
        self.passes(tag) && space.distance(&self.row, row) == found.distance
    }

    /// True if a neighbour that the insert found is one at its place too.
    pub(super) fn keeps(&self, found: &Neighbor, points: &KnownPoints, space: &Space) -> bool {
        let known = points.get(&found.id);
        let content = known.and_then(|(_, versions)| self.content(versions));
        content.is_some_and(|(tag, row)| self.finds_again(found, *tag, row, space))
    }

    /// True if every published point of the copy comes before it.
    pub(super) fn is_newest(&self) -> bool {
        self.revision == Some(AFTER_ALL)
    }

    /// The neighbours that may have left before its place. Change number `departure` is the last by which a point left; if
    /// the copy has later points too, the neighbours may have left after its place.
    pub(super) fn may_have_left(&self, departure: u64) -> &[Neighbor] {
        match self.is_newest() && departure > self.change {
            true => self.nearest(),
            false => &[],
        }
    }

    /// The number of neighbours that the search asks for at its place in the order.
    pub(super) fn k_at_place(&self) -> usize {
        let k = self.scaling.k(self.points_before).unwrap_or(self.k);
        match self.is_superset {
            false => k,
            // The points may have been counted later.
            true => k.max(self.k),
        }
    }

    /// The radius of the search at its place in the order, in a space of this dimension.
    pub(super) fn radius_at_place(&self, dimension: usize) -> f64 {
        let radius = self.scaling.radius(self.points_before, dimension);
        let radius = radius.unwrap_or(self.radius);
        match self.is_superset {
            false => radius,
            // The points may have been counted later.
            true => radius.max(self.radius),
        }
    }

    /// The neighbours that the point has at its place if no point arrives or leaves; none if the radius is the bound.
    pub(super) fn nearest(&self) -> &[Neighbor] {
        self.found.get(..self.k_at_place()).unwrap_or_default()
    }

    /// Those of these neighbours that the insert did not answer, because its number or its radius was smaller.
    pub(super) fn unanswered(&self) -> &[Neighbor] {
        let end = self.k_at_place().min(self.found.len());
        self.found.get(self.answer_len..end).unwrap_or_default()
    }

    /// No neighbour at its place is farther than this, unless a point that the insert found has left.
    pub(super) fn bound(&self, dimension: usize) -> f64 {
        let radius = self.radius_at_place(dimension);
        let farthest = self.nearest().last();
        farthest.map_or(radius, |farthest| farthest.distance.min(radius))
    }

    /// True if the point has more neighbours at its place than its insert searched for, and the copy may have had them.
    pub(super) fn is_short(&self) -> bool {
        self.found.len() >= self.reserve_k && self.k_at_place() > self.reserve_k
    }

    /// True if the radius is greater at its place than the one of its insert, and bounds the neighbours: others have removed
    /// points.
    pub(super) fn is_wider(&self, dimension: usize) -> bool {
        self.nearest().is_empty() && self.radius_at_place(dimension) > self.radius
    }

    /// The number of neighbours that a superset without a bound asks for at first. One of them is the point itself.
    pub(super) fn superset_k(&self) -> usize {
        match self.is_newest() {
            true => self.k_at_place().saturating_add(1).min(MAX_SUPERSET),
            // Others may have stored any number after it.
            false => MAX_SUPERSET,
        }
    }
}
