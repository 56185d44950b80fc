//! Rows of a mutation before its commit: a row sees the head and the rows before it, and no reader sees any of them.

use std::{
    collections::{HashMap, HashSet},
    sync::Arc,
};

use bytes::Bytes;
use wayfold_index::{Forest, ForestOptions, Neighbor, Point, PointRef, Points, Search, Space};

use super::{Error, answer::Source};
use crate::{
    log::{Effects, Outcome},
    registry::Published,
};

/// The head of an index and the rows that the next mutation has accepted so far.
pub(super) struct Staging {
    head: Arc<Published>,
    effects: Effects,
    /// The number of accepted rows that are new points.
    inserted: usize,
    searched: Option<Searched>,
}

/// The part that only searches need.
struct Searched {
    /// The accepted rows again, indexed. Its revisions count rows; the points carry the mutation's revision.
    forest: Forest,
    /// The slot of an accepted row in the effects, by id.
    slots: HashMap<u64, usize>,
    /// Ids hidden from searches of the head: those an accepted row replaced, and the current row's own.
    hidden: HashSet<u64>,
}

impl Staging {
    /// An empty staging. Later rows find earlier ones only if `searched` is set.
    pub(super) fn new(head: Arc<Published>, space: &Space, searched: bool) -> Self {
        Self {
            head,
            effects: Effects::new(space.coordinates()),
            inserted: 0,
            searched: searched.then(|| Searched {
                forest: Forest::new(space.clone(), ForestOptions::for_space(space)),
                slots: HashMap::new(),
                hidden: HashSet::new(),
            }),
        }
    }

    /// The revision that the mutation will make.
    pub(super) fn revision(&self) -> u64 {
        self.head.revision + 1
    }

    /// The number of points, accepted rows included.
    pub(super) fn points(&self) -> usize {
        self.head.snapshot.len() + self.inserted
    }

    /// The point that the head holds under an id.
    pub(super) fn held(&self, id: u64) -> Option<Point> {
        self.head.snapshot.get(id)
    }

    /// The payload of an accepted row.
    pub(super) fn accepted_payload(&self, id: u64) -> Option<Bytes> {
        let slot = *self.searched.as_ref()?.slots.get(&id)?;
        Some(self.effects.payload(slot))
    }

    /// Keeps the head's point of this id out of searches: a row is neither in its own way nor its own neighbour.
    pub(super) fn hide(&mut self, id: u64) {
        if let Some(searched) = &mut self.searched {
            searched.hidden.insert(id);
        }
    }

    /// Undoes [`Staging::hide`].
    pub(super) fn unhide(&mut self, id: u64) {
        if let Some(searched) = &mut self.searched {
            searched.hidden.remove(&id);
        }
    }

    /// The neighbours of a row in the head and in the rows before it. `known` is the answer of an earlier revision to
    /// this search or a wider one; since that revision points were only added.
    pub(super) fn search(
        &self,
        row: &[f64],
        search: &Search<'_>,
        known: Option<(u64, &[Neighbor])>,
    ) -> Result<Vec<Neighbor>, Error> {
        let Some(searched) = &self.searched else {
            return Ok(Vec::new());
        };
        // A known answer ignores hidden points.
        let known = known.filter(|_| searched.hidden.is_empty());
        let mut neighbors = searched.forest.search(row, search)?.neighbors;
        let mut at_head = *search;
        if let Some((revision, known)) = known {
            let within = known.partition_point(|neighbor| neighbor.distance <= search.radius);
            merge(&mut neighbors, &known[..within], search.k);
            if revision == self.head.revision {
                return Ok(neighbors);
            }
            let since = &mut at_head.filter.since_revision;
            *since = revision.max(*since);
        }
        // The ball is closed: at equal distance a point of the head precedes the last one found if its id is smaller.
        if let Some(farthest) = neighbors.last()
            && neighbors.len() >= search.k
        {
            at_head.radius = farthest.distance;
        }
        at_head.excluded = (!searched.hidden.is_empty()).then_some(&searched.hidden);
        let found = self.head.snapshot.search(row, &at_head)?.neighbors;
        merge(&mut neighbors, &found, search.k);
        Ok(neighbors)
    }

    /// Accepts a row.
    pub(super) fn accept(
        &mut self,
        id: u64,
        tag: u64,
        row: &[f64],
        payload: Bytes,
        outcome: Outcome,
    ) -> Result<(), Error> {
        let point = PointRef {
            id,
            tag,
            revision: self.revision(),
            row,
        };
        self.inserted += usize::from(outcome == Outcome::Inserted);
        self.effects.store(point, outcome, payload);
        let accepted = self.effects.stored().len();
        if let Some(searched) = &mut self.searched {
            searched.slots.insert(id, accepted - 1);
            let mut points = Points::with_capacity(row.len(), 1);
            points.push_point(point);
            let applied = searched.forest.apply(accepted as u64, &points, &[]);
            applied.map_err(|error| Error::Internal {
                what: format!("a row that was checked is refused: {error}"),
            })?;
        }
        Ok(())
    }

    /// The accepted rows.
    pub(super) fn into_effects(self) -> Effects {
        self.effects
    }
}

/// Merges `others` into the neighbours and keeps the nearest `k`.
fn merge(neighbors: &mut Vec<Neighbor>, others: &[Neighbor], k: usize) {
    if neighbors.is_empty() {
        neighbors.extend(&others[..others.len().min(k)]);
    } else if !others.is_empty() {
        neighbors.extend(others);
        neighbors.sort_unstable();
        neighbors.truncate(k);
    }
}

impl Source for Staging {
    fn point(&self, id: u64) -> Option<Point> {
        let slot = self
            .searched
            .as_ref()
            .and_then(|searched| searched.slots.get(&id));
        match slot {
            Some(&slot) => Some(self.effects.stored().get(slot).to_point()),
            None => self.held(id),
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use wayfold_index::{Filter, Linear};

    use super::*;
    use crate::{
        log::MemoryLog,
        registry::{Registry, RegistryOptions},
    };

    fn point(id: u64, revision: u64, row: &[f64]) -> PointRef<'_> {
        PointRef {
            id,
            tag: 0,
            revision,
            row,
        }
    }

    proptest! {
        #![proptest_config(crate::testing::cases(256))]

        /// On a grid most distances are ties. A search answers as over one set of head and accepted rows, with or
        /// without a known answer of an earlier head, which may be wider than the search.
        #[test]
        fn a_row_finds_the_nearest_of_the_head_and_the_rows_before_it(
            head in prop::collection::btree_map(0..60u64, 0..8u8, 0..30),
            rows in prop::collection::btree_map(0..60u64, 0..8u8, 0..30),
            seen in 0..30usize,
            since in 0..20u64,
            asked in 0..8u8,
            k in prop_oneof![1..6usize, Just(usize::MAX)],
            radius in prop_oneof![(0..5u8).prop_map(f64::from), Just(f64::INFINITY)],
            more in 0..4usize,
            farther in 0..3u8,
        ) {
            let space: Space = "R1".parse().unwrap();
            let registry = Registry::new(Arc::new(MemoryLog::new()), RegistryOptions::default());
            let (hosted, _) = registry.create("line", space.clone(), 1).unwrap();
            let mut forest = Forest::new(space.clone(), ForestOptions::for_space(&space));
            let mut union = Linear::new(space.clone());
            let filter = Filter { since_revision: since, ..Filter::default() };
            let search = Search { radius, filter, ..Search::nearest_k(k) };
            let asked = [f64::from(asked)];
            let mut known = (0, Vec::new());
            for (slot, (&id, &at)) in head.iter().enumerate() {
                let revision = slot as u64 + 1;
                let mut points = Points::new(1);
                points.push_point(point(id, revision, &[f64::from(at)]));
                forest.apply(revision, &points, &[]).unwrap();
                union.insert(point(id, revision, &[f64::from(at)])).unwrap();
                if slot == seen {
                    let search = Search {
                        k: k.saturating_add(more),
                        radius: radius + f64::from(farther),
                        ..search
                    };
                    known = (revision, forest.search(&asked, &search).unwrap().neighbors);
                }
            }
            let held: HashSet<u64> = head.keys().copied().collect();
            let head = Arc::new(Published {
                snapshot: forest.snapshot(),
                revision: forest.revision(),
                view: Arc::clone(&hosted.published().view),
            });
            let mut staging = Staging::new(head, &space, true);
            for (&id, &at) in &rows {
                if held.contains(&id) {
                    staging.hide(id);
                }
                staging.accept(id, 0, &[f64::from(at)], Bytes::new(), Outcome::Inserted).unwrap();
                union.insert(point(id, staging.revision(), &[f64::from(at)])).unwrap();
            }
            let expected = union.search(&asked, &search).unwrap().neighbors;
            for known in [None, Some((known.0, &*known.1))] {
                prop_assert_eq!(staging.search(&asked, &search, known).unwrap(), &*expected);
            }
        }
    }
}
