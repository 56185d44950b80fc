//! The neighbours of own points that came before them in the index's order, and that their inserts could not see.

use std::collections::{HashSet, VecDeque};

use wayfold_index::{Neighbor, Search};

use crate::index::local::{LocalPoints, NewRow};

/// The most answers that wait for the caller.
const MAX_WAITING: usize = 1 << 16;

/// The neighbours that an own point had when the server stored it, beyond those that its insert found.
#[derive(Clone, Debug, PartialEq)]
pub struct Meanwhile {
    /// The id of the own point.
    pub id: u64,
    /// Its neighbours, nearest first.
    pub neighbors: Vec<Neighbor>,
    /// True if some of them may have been in the answer of the insert, or come after the point: all points were read
    /// again between.
    pub is_superset: bool,
}

/// The question of an insert that the server has not stored yet.
#[derive(Clone, Debug)]
pub(super) struct Asked {
    pub(super) id: u64,
    row: Vec<f64>,
    search: Search<'static>,
    /// A neighbour that the answer could not see is no farther than this.
    bound: f64,
    /// The change that stored the point in the copy.
    at: u64,
    /// True if the copy was read again since.
    is_reloaded: bool,
}

impl Asked {
    /// The search with which the point `id` was inserted, and what it found: change number `at` of the copy stored the
    /// point.
    pub(super) fn new(
        id: u64,
        row: &[f64],
        search: Search<'static>,
        found: &[Neighbor],
        at: u64,
    ) -> Asked {
        let farthest = found.last().filter(|_| found.len() >= search.k);
        Asked {
            id,
            row: row.to_vec(),
            bound: farthest.map_or(search.radius, |farthest| farthest.distance),
            search,
            at,
            is_reloaded: false,
        }
    }
}

/// What others stored while own inserts with a question are under way.
#[derive(Debug, Default)]
pub(super) struct Arrivals {
    /// The number of questions under way.
    open: usize,
    /// The ids that others stored since the oldest question, each with its change.
    stored: VecDeque<(u64, u64)>,
    /// Answers for the caller.
    answers: VecDeque<Meanwhile>,
    /// True if an answer was dropped, because the caller took none.
    has_dropped: bool,
}

impl Arrivals {
    /// A question is under way.
    pub(super) fn open(&mut self) {
        self.open += 1;
    }

    /// A question will get no answer.
    pub(super) fn close(&mut self) {
        self.open = self.open.saturating_sub(1);
        if self.open == 0 {
            self.stored.clear();
        }
    }

    /// Another writer stored a point, as change number `at` of the copy.
    pub(super) fn push(&mut self, at: u64, row: &NewRow<'_>) {
        if self.open > 0 && row.is_new {
            self.stored.push_back((at, row.id));
        }
    }

    /// The points were read again, so the next answers are supersets.
    pub(super) fn reloaded(&mut self, asked: &mut Asked) {
        self.stored.clear();
        asked.is_reloaded = true;
    }

    /// The server has stored the point of a question: `points` are those up to it, and own points.
    pub(super) fn answer(&mut self, asked: &Asked, points: &LocalPoints) {
        let mut neighbors = match asked.is_reloaded {
            false => self.arrived(asked, points),
            true => {
                // The point itself is one of the nearest.
                let k = asked.search.k.saturating_add(1);
                let search = Search { k, ..asked.search };
                let answer = points.forest.search(&asked.row, &search);
                answer.map_or_else(|_| Vec::new(), |answer| answer.neighbors)
            }
        };
        neighbors.retain(|neighbor| neighbor.id != asked.id);
        neighbors.sort_unstable();
        neighbors.truncate(asked.search.k);
        self.close();
        if neighbors.is_empty() {
            return;
        }
        if self.answers.len() == MAX_WAITING {
            self.answers.pop_front();
            self.has_dropped = true;
        }
        self.answers.push_back(Meanwhile {
            id: asked.id,
            neighbors,
            is_superset: asked.is_reloaded,
        });
    }

    /// The points that arrived after the question's, within its bound.
    fn arrived(&self, asked: &Asked, points: &LocalPoints) -> Vec<Neighbor> {
        let after = self.stored.partition_point(|(at, _)| *at <= asked.at);
        let ids: HashSet<u64> = self.stored.range(after..).map(|(_, id)| *id).collect();
        let stored = ids.into_iter().filter_map(|id| points.get(id));
        let filter = asked.search.filter;
        let admitted = stored.filter(|point| point.tag & filter.tag_mask == filter.tag_value);
        let space = points.forest.space();
        let neighbors = admitted.map(|point| Neighbor {
            distance: space.distance(&asked.row, &point.row),
            id: point.id,
        });
        neighbors
            .filter(|neighbor| neighbor.distance <= asked.bound)
            .collect()
    }

    /// The answers so far, and true if none was dropped.
    pub(super) fn take(&mut self) -> (Vec<Meanwhile>, bool) {
        let is_complete = !std::mem::take(&mut self.has_dropped);
        (self.answers.drain(..).collect(), is_complete)
    }
}
