//! The places of own points in the index's order, and the neighbours before them that their inserts could not see.

mod arrival;
mod open_search;

use std::collections::{HashMap, HashSet, VecDeque};

use wayfold_index::{ForestSnapshot, Neighbor, Search, Space};

use super::rebased::{Content, Difference};
pub(super) use arrival::Reloaded;
use arrival::{Arrival, WHOLE_PLACE};
pub(super) use open_search::{InsertSearch, OpenSearch};

/// The most bytes of the answers that wait for the caller.
const MAX_BYTES: usize = 16 << 20;

/// The most points of others that wait for open searches, 64 bytes each.
const MAX_ARRIVALS: usize = 1 << 20;

/// The most neighbours of a superset of all points that no distance bounds: the nearest ones. It may miss a neighbour if
/// `k` is about this number or greater, or if the search asks for later points only.
const MAX_SUPERSET: usize = 1 << 16;

/// The most points of others for exact answers to the searches of one batch: a lookup of each holds up all callers.
const MAX_EXACT: usize = 1 << 16;

/// The most distances for the exact answers to the searches of one batch. The feed waits for them, some seconds at most.
const MAX_DISTANCES: usize = 1 << 26;

/// The most distances that the thread of all calls computes at once: about a millisecond.
const MAX_INLINE_DISTANCES: usize = 1 << 14;

/// An own point's place in the index's order, and the neighbours that it had there beyond those that its insert answered.
///
/// With a scaled `k` or radius the insert counts the points of the copy, and this answer counts
/// [`points_before`](Meanwhile::points_before). If that gives a greater `k`, the neighbours include the older points that the
/// insert left out. The point's neighbours among all points before it are the k(`points_before`) nearest of both answers that
/// others have neither removed nor moved meanwhile.
#[derive(Clone, Debug, PartialEq)]
pub struct Meanwhile {
    /// The id of the own point.
    pub id: u64,
    /// The number of points that the index had just before it; if `is_superset`, maybe at a later moment.
    pub points_before: usize,
    /// Its neighbours, nearest first. With [`Search::since`](crate::Search::since), points that only got their tag since are
    /// among them, and take no place of the others.
    pub neighbors: Vec<Neighbor>,
    /// True if the copy read all points again meanwhile, if others stored very many points, or if they removed a neighbour
    /// that the insert had found, moved it or gave it another tag. Some neighbours may then have been in the answer of the
    /// insert, or come after the point, and one that was stored again after it may be missing. If the copy had the point
    /// already when it read all points again, an older one that takes the place of a removed neighbour may be missing too.
    /// With [`Search::since`](crate::Search::since) all points count as later ones once the copy has read them again, and
    /// may take the places of those that are. Unless the copy read all points again, they are as this process shows them,
    /// with its later writes. For a scaled `k`, as many points as the copy had and 4,096 more count as very many.
    pub is_superset: bool,
}

/// The answers to the searches of inserts, as far as the server has stored the points.
#[derive(Clone, Debug, Default, PartialEq)]
#[non_exhaustive]
pub struct MeanwhileAnswers {
    /// One for each search.
    pub answers: Vec<Meanwhile>,
    /// The number of searches without an answer yet: the feed has not named their points.
    pub open: usize,
    /// True if answers were dropped since the last call, because no one took them.
    pub has_dropped: bool,
}

impl Meanwhile {
    fn bytes(&self) -> usize {
        size_of::<Meanwhile>() + size_of_val(&self.neighbors[..])
    }
}

/// Searches under way, the points that others stored since, and the answers for the caller.
#[derive(Debug, Default)]
pub(super) struct OpenSearches {
    open: usize,
    /// The points that others stored since the oldest open search.
    stored: VecDeque<Arrival>,
    /// The last change by which another writer removed or moved a point, or gave it another tag.
    departure: u64,
    answers: VecDeque<Meanwhile>,
    /// The bytes of all answers.
    bytes: usize,
    has_dropped: bool,
}

/// The contents of a point, each before a step of the batch.
pub(super) type Versions = Vec<(usize, Option<Content>)>;

/// By id: the changes of a point, the oldest first, and its contents.
type KnownPoints = HashMap<u64, (Vec<Arrival>, Versions)>;

/// Searches whose points the server has stored, with everything that their answers need.
#[derive(Debug)]
pub(super) struct Answerable {
    searches: Vec<OpenSearch>,
    /// The points that an answer may name.
    points: KnownPoints,
    /// The ids of the own writes in the batch of the searches and in the pending ones after it, if there is a snapshot.
    later: HashSet<u64>,
    /// The last change by which another writer removed or moved a point, or gave it another tag.
    departure: u64,
    snapshot: Option<ForestSnapshot>,
}

impl OpenSearches {
    /// A search is under way.
    pub(super) fn open(&mut self) {
        self.open += 1;
    }

    /// `count` searches will get no answer.
    pub(super) fn close(&mut self, count: usize) {
        self.open -= count.min(self.open);
        if self.open == 0 {
            self.stored.clear();
        }
    }

    /// True if a search is under way.
    pub(super) fn are_open(&self) -> bool {
        self.open > 0
    }

    /// Another writer stored a point, as change number `change` of the copy.
    pub(super) fn push(&mut self, change: u64, id: u64, difference: Difference) {
        if self.are_open() {
            self.stored.push_back(Arrival {
                change,
                id,
                difference,
                revision: None,
            });
        }
    }

    /// The copy was read again, as change number `change`: others may have stored this point before or after any search.
    pub(super) fn push_unplaced(&mut self, change: u64, id: u64) {
        if self.are_open() {
            self.stored.push_back(Arrival {
                change,
                id,
                difference: Difference::plain(None),
                revision: Some(0),
            });
        }
    }

    /// The copy was read again, as change number `change`.
    pub(super) fn reload(&mut self, change: u64, changes: &Reloaded) {
        if self.are_open() {
            let stored = changes.stored.iter();
            let stored = stored.map(|&(id, revision, old_tag)| Arrival {
                change,
                id,
                difference: Difference::plain(old_tag),
                revision: Some(revision),
            });
            self.stored.extend(stored);
        }
    }

    /// Another writer removed or moved a point or gave it another tag, as change number `change` of the copy: the point
    /// may have been in an answer.
    pub(super) fn depart(&mut self, change: u64) {
        self.departure = change;
    }

    /// True if the points that others stored take too much memory: answer the open searches from all points
    /// then.
    pub(super) fn is_full(&self) -> bool {
        self.stored.len() > MAX_ARRIVALS
    }

    /// Forgets the points that others stored.
    pub(super) fn forget(&mut self) {
        self.stored = VecDeque::new();
    }

    /// The server has stored the points of these searches. `later` are the ids of their batch and of the pending ones after it.
    /// `published` has what is published under an id, and `snapshot` takes all points. `oldest` is the oldest of the searches
    /// that stay open.
    pub(super) fn answerable(
        &mut self,
        space: &Space,
        mut searches: Vec<OpenSearch>,
        later: impl FnOnce() -> HashSet<u64>,
        oldest: Option<&OpenSearch>,
        mut published: impl FnMut(u64) -> Versions,
        snapshot: impl FnOnce() -> ForestSnapshot,
    ) -> Option<Answerable> {
        let first = searches.first()?.change;
        let mut after = self
            .stored
            .partition_point(|arrival| arrival.change <= first);
        let arrivals = self.stored.len() - after;
        if arrivals > MAX_EXACT || searches.len().saturating_mul(arrivals) > MAX_DISTANCES {
            searches.iter_mut().for_each(OpenSearch::search_all);
            after = self.stored.len();
        }
        let is_short = |open: &OpenSearch| open.is_short() || open.is_wider(space.dimension());
        let short = searches.iter_mut().filter(|open| is_short(open));
        short.for_each(OpenSearch::search_all);
        let mut changes: HashMap<u64, Vec<Arrival>> = HashMap::new();
        for arrival in self.stored.range(after..) {
            changes.entry(arrival.id).or_default().push(*arrival);
        }
        // An older point may have no change, and is looked up too.
        let departure = self.departure;
        for open in searches.iter().filter(|open| !open.searches_all) {
            let neighbors = open.unanswered().iter();
            for neighbor in neighbors.chain(open.may_have_left(departure)) {
                changes.entry(neighbor.id).or_default();
            }
        }
        // A point that was stored twice counts as it is now.
        let points = changes
            .into_iter()
            .map(|(id, changes)| (id, (changes, published(id))));
        let points: KnownPoints = points.collect();
        // An older point that has no change takes the place of a neighbour that has left.
        for open in searches.iter_mut().filter(|open| !open.searches_all) {
            let mut neighbors = open.may_have_left(departure).iter();
            if !neighbors.all(|found| open.keeps(found, &points, space)) {
                open.search_all();
            }
        }
        let searches_all = searches.iter().any(|open| open.searches_all);
        let answerable = Answerable {
            points,
            later: searches_all.then(later).unwrap_or_default(),
            departure,
            snapshot: searches_all.then(snapshot),
            searches,
        };
        if let Some(oldest) = oldest {
            let kept = self
                .stored
                .partition_point(|arrival| arrival.change <= oldest.change);
            self.stored.drain(..kept);
        }
        Some(answerable)
    }

    /// A search has this answer, and is closed.
    pub(super) fn add(&mut self, answer: Meanwhile) {
        self.close(1);
        self.bytes += answer.bytes();
        self.answers.push_back(answer);
        while self.bytes > MAX_BYTES
            && let Some(oldest) = self.answers.pop_front()
        {
            self.bytes -= oldest.bytes();
            self.has_dropped = true;
        }
    }

    /// True if an answer is under way and none is here.
    pub(super) fn are_awaited(&self) -> bool {
        self.open > 0 && self.answers.is_empty()
    }

    /// Returns no answer, and keeps all for the next call.
    pub(super) fn no_answers(&self) -> MeanwhileAnswers {
        MeanwhileAnswers {
            open: self.open + self.answers.len(),
            ..MeanwhileAnswers::default()
        }
    }

    /// The answers so far.
    pub(super) fn take(&mut self) -> MeanwhileAnswers {
        self.bytes = 0;
        MeanwhileAnswers {
            answers: self.answers.drain(..).collect(),
            open: self.open,
            has_dropped: std::mem::take(&mut self.has_dropped),
        }
    }
}

impl Answerable {
    /// True if the answers take too long for a thread that other tasks wait for.
    pub(super) fn is_long(&self) -> bool {
        self.snapshot.is_some() || self.searches.len() * self.points.len() > MAX_INLINE_DISTANCES
    }

    /// The answers, in the order of the searches.
    pub(super) fn answers(&self, space: &Space) -> impl Iterator<Item = Meanwhile> {
        self.searches.iter().map(|open| Meanwhile {
            id: open.id,
            points_before: open.points_before,
            neighbors: match open.searches_all {
                false => self.unseen(open, space),
                true => self.superset(open, space),
            },
            is_superset: open.is_superset,
        })
    }

    /// The points that arrived after the search's own, within its bound, and the older ones that its insert did not answer.
    fn unseen(&self, open: &OpenSearch, space: &Space) -> Vec<Neighbor> {
        let passes = |tag: u64| open.passes(tag);
        let points = self.points.iter();
        let contents = points
            .filter_map(|(id, (changes, versions))| Some((changes, *id, open.content(versions)?)));
        let is_new = |changes: &[Arrival]| {
            let mut unseen = changes.iter().filter(|arrival| arrival.is_unseen(open));
            unseen.any(|arrival| arrival.is_new(open))
        };
        let unseen = contents.filter(|(changes, id, (tag, _))| {
            let Some(first) = changes.iter().find(|arrival| arrival.is_unseen(open)) else {
                return false;
            };
            let old_tag = first.difference.old_tag_in(open.change);
            // Another writer may have stored a point under the same id.
            let is_other = *id != open.id;
            is_other && passes(*tag) && (is_new(changes) || !old_tag.is_some_and(passes))
        });
        let neighbors = unseen.map(|(changes, id, (_, row))| {
            let distance = space.distance(&open.row, row);
            let last = changes.iter().rfind(|arrival| !arrival.is_hidden(open));
            let last = last.filter(|arrival| arrival.is_unseen(open));
            // A search for later points does not count one that has only got its tag since.
            let counts = open.filter.since_revision == 0 || is_new(changes);
            let last = last.filter(|_| counts);
            let place = last.map_or(0, |arrival| arrival.place(open));
            (Neighbor { distance, id }, place)
        });
        // An older point that was moved is among the arrivals.
        let older = open.unanswered().iter();
        let older = older.filter(|old| open.keeps(old, &self.points, space));
        let neighbors = neighbors.chain(older.map(|old| (*old, WHOLE_PLACE)));
        // If the copy has no later points, the neighbours that the insert found have stayed: `superset` answers otherwise.
        let bound = match open.is_newest() || self.departure <= open.change {
            true => open.bound(space.dimension()),
            false => open.radius_at_place(space.dimension()),
        };
        let near = neighbors.filter(|(neighbor, _)| neighbor.distance <= bound);
        let mut neighbors: Vec<_> = near.collect();
        neighbors.sort_unstable();
        // An older point may have been stored again with the same state.
        neighbors.dedup_by_key(|(neighbor, _)| neighbor.id);
        // Those that may have come later take no place of the others.
        let mut left = open.k_at_place().saturating_mul(WHOLE_PLACE);
        let within = neighbors.into_iter().take_while(|(_, place)| {
            let has_place = left > 0;
            left = left.saturating_sub(*place);
            has_place
        });
        within.map(|(neighbor, _)| neighbor).collect()
    }

    /// All points within the bound. If there is no bound, or a point that the insert found has left or moved: the nearest
    /// within the radius.
    fn superset(&self, open: &OpenSearch, space: &Space) -> Vec<Neighbor> {
        let Some(points) = &self.snapshot else {
            return Vec::new();
        };
        let stays = |found: &Neighbor| {
            let point = points.get(found.id);
            point.is_some_and(|point| open.finds_again(found, point.tag, &point.row, space))
        };
        let bound = open.bound(space.dimension());
        let is_bounded = bound.is_finite() && !open.is_short();
        let mut search = match is_bounded && open.nearest().iter().all(stays) {
            true => Search::nearest_r(bound),
            false => Search {
                radius: open.radius_at_place(space.dimension()),
                ..Search::nearest_k(open.superset_k())
            },
        };
        search.filter = open.filter;
        loop {
            let answer = points.search(&open.row, &search);
            let mut neighbors = answer.map_or_else(|_| Vec::new(), |answer| answer.neighbors);
            let has_all = neighbors.len() < search.k;
            neighbors.retain(|neighbor| neighbor.id != open.id);
            if search.k >= MAX_SUPERSET {
                return neighbors;
            }
            // Own writes may have come later, and take no place of the others.
            let mut left = open.k_at_place();
            let within = neighbors.iter().take_while(|neighbor| {
                let has_place = left > 0;
                left -= usize::from(has_place && !self.later.contains(&neighbor.id));
                has_place
            });
            neighbors.truncate(within.count());
            if left == 0 || has_all {
                return neighbors;
            }
            // Thousands of them may be pending, and few are near: a search beyond all of them would take long.
            search.k = search.k.saturating_mul(2).min(MAX_SUPERSET);
        }
    }
}

#[cfg(test)]
mod tests;
