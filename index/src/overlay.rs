//! Changes on top of a snapshot: writes that are under way and not yet part of it.

use std::collections::HashSet;

use crate::{
    ApplyError, Forest, ForestOptions, Neighbor, Point, Points, Search, SearchError, Snapshot,
    Space,
};

/// Changes to some of the points below it, which are those of a [`Snapshot`] and of earlier overlays: points that it stores,
/// and ids that it removes.
#[derive(Debug)]
pub struct Overlay {
    space: Space,
    /// The points that it stores; None before the first change, since most overlays never get one. Its revisions count
    /// changes; the points carry their own.
    forest: Option<Forest>,
    /// The ids that it stores or removes. It hides the points below that have them.
    changed: HashSet<u64>,
}

impl Overlay {
    /// An overlay without changes.
    pub fn new(space: &Space) -> Self {
        Self {
            space: space.clone(),
            forest: None,
            changed: HashSet::new(),
        }
    }

    /// Removes the points with the ids `removed`, then stores `stored`, replacing points with the same ids.
    ///
    /// # Errors
    /// The errors of [`Forest::apply`]; nothing is changed then.
    pub fn apply(&mut self, stored: &Points, removed: &[u64]) -> Result<(), ApplyError> {
        let forest = self.forest.get_or_insert_with(|| {
            let options = ForestOptions::for_space(&self.space);
            Forest::new(self.space.clone(), options)
        });
        forest.apply(forest.revision() + 1, stored, removed)?;
        self.changed.extend(stored.ids());
        self.changed.extend(removed);
        Ok(())
    }

    /// The point that it stores under an id, or None inside if it removes the id; None outside if it does not change the id.
    pub fn get(&self, id: u64) -> Option<Option<Point>> {
        let is_changed = self.changed.contains(&id);
        is_changed.then(|| self.forest.as_ref()?.get(id))
    }
}

/// Answers `search` over a snapshot as `overlays` change it, the oldest first. With `known`, the snapshot is not searched: the
/// neighbours in it are known, at least the nearest `search.k` within `search.radius`, and no overlay changes one of them.
///
/// # Errors
/// The errors of [`Snapshot::search`].
pub fn search_overlaid(
    snapshot: &Snapshot,
    overlays: &[&Overlay],
    known: Option<&[Neighbor]>,
    state: &[f64],
    search: &Search<'_>,
) -> Result<Vec<Neighbor>, SearchError> {
    let mut hidden: Vec<&HashSet<u64>> = search.excluded.to_vec();
    let mut neighbors = Vec::new();
    if let Some(known) = known {
        let within = known.partition_point(|neighbor| neighbor.distance <= search.radius);
        merge(&mut neighbors, &known[..within], search.k);
    }
    for overlay in overlays.iter().rev() {
        let Some(forest) = &overlay.forest else {
            continue;
        };
        let narrowed = narrowed(search, &neighbors, &hidden);
        let found = forest.search(state, &narrowed)?.neighbors;
        merge(&mut neighbors, &found, search.k);
        hidden.push(&overlay.changed);
    }
    if known.is_none() {
        let narrowed = narrowed(search, &neighbors, &hidden);
        let found = snapshot.search(state, &narrowed)?.neighbors;
        merge(&mut neighbors, &found, search.k);
    }
    Ok(neighbors)
}

/// The search for what can still be among the nearest. The ball is closed: at equal distance a point precedes the farthest
/// one found if its id is smaller.
fn narrowed<'a>(
    search: &Search<'a>,
    found: &[Neighbor],
    hidden: &'a [&'a HashSet<u64>],
) -> Search<'a> {
    let farthest = found.last().filter(|_| found.len() >= search.k);
    Search {
        radius: farthest.map_or(search.radius, |farthest| farthest.distance),
        excluded: hidden,
        ..*search
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
