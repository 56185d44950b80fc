//! Rows of a mutation before its commit: a row sees the index as pending mutations leave it, and the rows before it. No
//! reader sees any of them.

use std::collections::{HashMap, HashSet};

use bytes::Bytes;
use wayfold_index::{Neighbor, Overlay, Point, PointRef, Points, Search, search_overlaid};

use super::{Error, answer::Source};
use crate::{
    log::{Effects, Outcome},
    registry::Writer,
};

/// The newest state of an index and the rows that the next mutation has accepted so far.
pub(super) struct Staging<'a> {
    /// Its pending records are indexed.
    writer: &'a Writer,
    effects: Effects,
    /// The number of accepted rows that are new points.
    inserted: usize,
    searched: Option<Searched>,
}

/// The part that only searches need.
struct Searched {
    /// The accepted rows again, indexed.
    accepted: Overlay,
    /// The slot of an accepted row in the effects, by id.
    slots: HashMap<u64, usize>,
    /// The id of the current row, if a point has it already.
    hidden: HashSet<u64>,
    /// True if an accepted row replaced a point.
    replaced: bool,
}

impl<'a> Staging<'a> {
    /// An empty staging. Later rows find earlier ones only if `searched` is set.
    pub(super) fn new(writer: &'a Writer, searched: bool) -> Self {
        let space = writer.space();
        Self {
            writer,
            effects: Effects::new(space.coordinates()),
            inserted: 0,
            searched: searched.then(|| Searched {
                accepted: Overlay::new(space),
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

    /// The payload of an accepted row.
    pub(super) fn accepted_payload(&self, id: u64) -> Option<Bytes> {
        let slot = *self.searched.as_ref()?.slots.get(&id)?;
        Some(self.effects.payload(slot))
    }

    /// Keeps the stored point of this id out of searches for the current row: a row is neither in its own way nor its own
    /// neighbour.
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

    /// The neighbours of a row in the newest state and in the rows before it. `known` is the answer of an earlier published
    /// revision to this search or a wider one; since that revision points were only added.
    pub(super) fn search(
        &self,
        row: &[f64],
        search: &Search<'_>,
        known: Option<(u64, &[Neighbor])>,
    ) -> Result<Vec<Neighbor>, Error> {
        let Some(searched) = &self.searched else {
            return Ok(Vec::new());
        };
        let hidden = [&searched.hidden];
        let mut search = *search;
        if !searched.hidden.is_empty() {
            search.excluded = &hidden;
        }
        let [older, newer] = self.writer.overlays();
        let overlays = [older, newer, &searched.accepted];
        let snapshot = &self.writer.base().snapshot;
        // A known answer ignores what is hidden or replaced.
        let known = known.filter(|_| searched.hidden.is_empty() && !searched.replaced);
        let Some((revision, known)) = known else {
            return Ok(search_overlaid(snapshot, &overlays, None, row, &search)?);
        };
        let since = &mut search.filter.since_revision;
        *since = revision.max(*since);
        if revision == self.writer.base().revision {
            return Ok(search_overlaid(
                snapshot,
                &overlays,
                Some(known),
                row,
                &search,
            )?);
        }
        let mut neighbors = search_overlaid(snapshot, &overlays, None, row, &search)?;
        let within = known.partition_point(|neighbor| neighbor.distance <= search.radius);
        neighbors.extend(&known[..within]);
        neighbors.sort_unstable();
        neighbors.truncate(search.k);
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
            searched.hidden.clear();
            searched.replaced |= outcome != Outcome::Inserted;
            let mut points = Points::with_capacity(row.len(), 1);
            points.push_point(point);
            let applied = searched.accepted.apply(&points, &[]);
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

impl Source for Staging<'_> {
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
