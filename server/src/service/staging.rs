//! Rows of a mutation before its commit: a row sees the index as pending mutations leave it, and the rows before it. No
//! reader sees any of them.

use std::{
    collections::{HashMap, HashSet},
    sync::Arc,
};

use bytes::Bytes;
use wayfold_index::{
    EarlierAnswer, Neighbor, Overlay, Point, PointRef, Points, Search, search_overlaid,
};

use super::Error;
use crate::{
    log::{Effects, Outcome},
    registry::Writer,
};

/// The newest state of an index and the rows that the next mutation has accepted so far.
pub(super) struct Staging<'a> {
    /// Its pending records are indexed.
    writer: &'a Writer,
    /// The accepted rows.
    pub(super) effects: Effects,
    /// The number of accepted rows that are new points.
    inserted: usize,
    searched: Option<SearchState>,
}

/// The part that only searches need.
struct SearchState {
    /// The accepted rows again, indexed. A search adds those accepted since the search before: most inserts have one
    /// row, which nothing searches.
    accepted: Overlay,
    /// The slot of an indexed row in the effects, by id.
    slots: HashMap<u64, usize>,
    /// The id of the current row, if a point has it already.
    hidden: HashSet<u64>,
    /// True if an accepted row replaced a point.
    replaced: bool,
}

impl SearchState {
    /// Indexes the accepted rows that are not indexed yet. An id is accepted once.
    fn index(&mut self, accepted: &Points) -> Result<(), Error> {
        let indexed = self.slots.len();
        if indexed == accepted.len() {
            return Ok(());
        }
        let mut points = Points::new(accepted.coordinates());
        for slot in indexed..accepted.len() {
            let point = accepted.get(slot);
            self.slots.insert(point.id, slot);
            points.push_point(point);
        }
        let applied = self.accepted.apply(&points, &[]);
        applied.map_err(|error| Error::Internal {
            what: format!("a row that was checked is refused: {error}"),
        })
    }
}

impl<'a> Staging<'a> {
    /// An empty staging. Later rows find earlier ones only if `searched` is set.
    pub(super) fn new(writer: &'a Writer, searched: bool) -> Self {
        let space = writer.space();
        Self {
            writer,
            effects: Effects::new(space.coordinates()),
            inserted: 0,
            searched: searched.then(|| SearchState {
                accepted: Overlay::new(Arc::clone(space)),
                slots: HashMap::new(),
                hidden: HashSet::new(),
                replaced: false,
            }),
        }
    }

    /// The revision that the mutation will make.
    pub(super) fn revision(&self) -> u64 {
        self.writer.revision() + 1
    }

    /// The number of points, accepted rows included.
    pub(super) fn points(&self) -> usize {
        self.writer.points() + self.inserted
    }

    /// The point that was stored under an id before this mutation.
    pub(super) fn held(&self, id: u64) -> Option<Point> {
        self.writer.get(id)
    }

    /// True if a writer session reserved this id.
    pub(super) fn is_reserved(&self, id: u64) -> bool {
        self.writer.sessions().owner(id).is_some()
    }

    /// The payload of an accepted row that a search found.
    pub(super) fn accepted_payload(&self, id: u64) -> Option<Bytes> {
        let slot = *self.searched.as_ref()?.slots.get(&id)?;
        Some(self.effects.payload(slot))
    }

    /// Keeps the stored point of this id out of searches for the current row: a row is neither in its own way nor its
    /// own neighbour.
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

    /// The neighbours of a row in the newest state and in the rows before it. `known` answers this search or a wider
    /// one at an earlier published revision; since that revision points were only added.
    pub(super) fn search(
        &mut self,
        row: &[f64],
        search: &Search<'_>,
        known: Option<EarlierAnswer<'_>>,
    ) -> Result<Vec<Neighbor>, Error> {
        let Some(searched) = &mut self.searched else {
            return Ok(Vec::new());
        };
        searched.index(self.effects.stored())?;
        let hidden = [&searched.hidden];
        let mut search = *search;
        if !searched.hidden.is_empty() {
            search.excluded = &hidden;
        }
        // With a replaced neighbour a known answer may lack one beyond its last.
        let known = known.filter(|_| !searched.replaced);
        let [older, newer] = self.writer.overlays();
        let overlays = [older, newer, &searched.accepted];
        let snapshot = &self.writer.base().snapshot;
        Ok(search_overlaid(snapshot, &overlays, known, row, &search)?)
    }

    /// Accepts a row.
    pub(super) fn accept(
        &mut self,
        id: u64,
        tag: u64,
        row: &[f64],
        payload: Bytes,
        outcome: Outcome,
    ) {
        let point = PointRef {
            id,
            tag,
            revision: self.revision(),
            row,
        };
        self.inserted += usize::from(outcome == Outcome::Inserted);
        self.effects.store(point, outcome, payload);
        if let Some(searched) = &mut self.searched {
            searched.hidden.clear();
            searched.replaced |= outcome != Outcome::Inserted;
        }
    }

    /// The point with this id, the accepted rows included.
    pub(super) fn point(&self, id: u64) -> Option<Point> {
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
    use futures_util::poll;
    use proptest::prelude::*;
    use wayfold_index::{Filter, Linear, Space};

    use super::*;
    use crate::{
        log::MemoryLog,
        registry::{CommitOutcome, Registry, RegistryOptions},
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

        /// On a grid most distances are ties. A search answers as over one set of published, pending and accepted rows,
        /// with or without a known answer of an earlier published revision, which may be wider than the search and has
        /// the hidden point.
        #[test]
        fn a_row_finds_the_nearest_of_the_newest_state_and_the_rows_before_it(
            stored in prop::collection::btree_map(0..60u64, 0..8u8, 0..30),
            rows in prop::collection::btree_map(0..60u64, 0..8u8, 0..30),
            published in 0..30usize,
            seen in 0..30usize,
            since in 0..20u64,
            query in 0..8u8,
            k in prop_oneof![1..6usize, Just(usize::MAX)],
            radius in prop_oneof![(0..5u8).prop_map(f64::from), Just(f64::INFINITY)],
            more in 0..4usize,
            farther in 0..3u8,
            hidden in prop::option::of(0..60u64),
        ) {
            let runtime = tokio::runtime::Builder::new_current_thread().build().unwrap();
            let space: Space = "R1".parse().unwrap();
            let mut union = Linear::new(space.clone());
            let filter = Filter { since_revision: since, ..Filter::default() };
            let search = Search { radius, filter, ..Search::nearest_k(k) };
            let query = [f64::from(query)];
            runtime.block_on(async {
                let registry =
                    Registry::new(Arc::new(MemoryLog::new()), RegistryOptions::default());
                let (hosted, _) = registry.create("line", space.clone(), Default::default(), &[]).unwrap();
                let (mut known, mut under_way) = ((0, Vec::new()), Vec::new());
                for (slot, (&id, &at)) in stored.iter().enumerate() {
                    let writer = hosted.write().await.unwrap();
                    let row = [f64::from(at)];
                    let point = point(id, writer.revision() + 1, &row);
                    union.insert(point).unwrap();
                    let mut effects = Effects::new(1);
                    effects.store(point, Outcome::Inserted, Bytes::new());
                    let mut commit = Box::pin(hosted.commit(writer, effects));
                    if slot >= published {
                        // Submitted at the first poll, and published once the apply loop runs.
                        assert!(poll!(&mut commit).is_pending());
                        under_way.push(commit);
                        continue;
                    }
                    assert_eq!(commit.await.unwrap(), CommitOutcome::Done);
                    if slot == seen {
                        let search = Search {
                            k: k.saturating_add(more),
                            radius: radius + f64::from(farther),
                            ..search
                        };
                        let published = hosted.published();
                        let found = published.snapshot.search(&query, &search).unwrap();
                        known = (published.revision, found.neighbors);
                    }
                }
                let mut writer = hosted.write().await.unwrap();
                assert_eq!(writer.revision(), stored.len() as u64);
                assert_eq!(writer.points(), stored.len());
                writer.index_pending();
                let mut staging = Staging::new(&writer, true);
                for (&id, &at) in &rows {
                    let held = staging.held(id);
                    assert_eq!(held.map(|point| point.row[0]), stored.get(&id).copied().map(f64::from));
                    let outcome = match stored.contains_key(&id) {
                        true => Outcome::Replaced,
                        false => Outcome::Inserted,
                    };
                    let row = [f64::from(at)];
                    staging.accept(id, 0, &row, Bytes::new(), outcome);
                    union.insert(point(id, staging.revision(), &row)).unwrap();
                }
                if let Some(id) = hidden {
                    staging.hide(id);
                    union.remove(id);
                }
                let expected = union.search(&query, &search).unwrap().neighbors;
                let known = EarlierAnswer { revision: known.0, neighbors: &known.1 };
                for known in [None, Some(known)] {
                    assert_eq!(staging.search(&query, &search, known).unwrap(), expected);
                }
            });
        }
    }
}
