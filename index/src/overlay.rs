//! Changes on top of a snapshot: writes that are under way and not yet part of it.

use std::{collections::HashSet, sync::Arc};

use crate::{
    ApplyError, Forest, ForestOptions, ForestSnapshot, Neighbor, Point, Points, Search,
    SearchError, Space,
};

/// Changes to some of the points below it, which are those of a [`ForestSnapshot`] and of earlier overlays: points that it
/// stores, and ids that it removes.
#[derive(Debug)]
pub struct Overlay {
    space: Arc<Space>,
    /// The stored points; None before the first change. Its revisions count changes; the points carry their own.
    stored: Option<Forest>,
    /// The ids that it stores or removes. It hides the points below that have them.
    changed: HashSet<u64>,
}

impl Overlay {
    /// An overlay without changes.
    pub fn new(space: impl Into<Arc<Space>>) -> Self {
        Self {
            space: space.into(),
            stored: None,
            changed: HashSet::new(),
        }
    }

    /// Removes the points with the ids `removed`, then stores `stored`, replacing points with the same ids.
    ///
    /// # Errors
    /// The errors of [`Forest::apply`]; nothing is changed then.
    pub fn apply(&mut self, stored: &Points, removed: &[u64]) -> Result<(), ApplyError> {
        stored.check(&self.space)?;
        let forest = self.stored.get_or_insert_with(|| {
            let options = ForestOptions::for_space(&self.space);
            Forest::new(Arc::clone(&self.space), options)
        });
        forest.apply_checked(forest.revision() + 1, stored, removed);
        self.changed.extend(stored.ids());
        self.changed.extend(removed);
        Ok(())
    }

    /// Prepares it for many searches. Each would scan a large change from end to end.
    pub fn settle(&mut self) {
        if let Some(stored) = &mut self.stored {
            stored.settle();
        }
    }

    /// The point that it stores under an id, or None inside if it removes the id; None outside if it does not change
    /// the id.
    pub fn get(&self, id: u64) -> Option<Option<Point>> {
        let stored = self.stored.as_ref()?;
        self.changed.contains(&id).then(|| stored.get(id))
    }
}

/// The neighbours that an earlier search found.
#[derive(Clone, Copy, Debug)]
pub struct EarlierAnswer<'a> {
    /// The revision of the searched snapshot.
    pub revision: u64,
    /// The nearest points of that revision, nearest first: at least as many and as far as the search to answer asks
    /// for. Their search excluded no point that the search to answer admits.
    pub neighbors: &'a [Neighbor],
}

/// Answers `search` over a snapshot as `overlays` change it, the oldest first. With `known`, only the snapshot's points
/// after that revision are searched, unless it has a point that `search` excludes: since that revision points were only
/// added. An overlay may have changes from before it.
///
/// # Errors
/// The errors of [`ForestSnapshot::search`].
pub fn search_overlaid(
    snapshot: &ForestSnapshot,
    overlays: &[&Overlay],
    known: Option<EarlierAnswer<'_>>,
    state: &[f64],
    search: &Search<'_>,
) -> Result<Vec<Neighbor>, SearchError> {
    search.check(snapshot.space(), state)?;
    let mut hidden: Vec<&HashSet<u64>> = search.excluded.to_vec();
    let mut neighbors = Vec::new();
    // With an excluded neighbour the answer may lack one beyond its last, and no filter admits only what came after
    // revision 0.
    let known = known.filter(|known| {
        let mut ids = known.neighbors.iter().map(|neighbor| neighbor.id);
        known.revision > 0 && !ids.any(|id| search.excludes(id))
    });
    // The known neighbours come first: their distances bound all later searches. An overlay finds the points that it
    // stores itself.
    if let Some(known) = known {
        let within = known.neighbors.iter();
        let within = within.take_while(|neighbor| neighbor.distance <= search.radius);
        let is_changed = |id| overlays.iter().any(|overlay| overlay.changed.contains(id));
        let unchanged = within.filter(|neighbor| !is_changed(&neighbor.id));
        neighbors.extend(unchanged.take(search.k));
    }
    for overlay in overlays.iter().rev() {
        let Some(stored) = &overlay.stored else {
            continue;
        };
        let narrowed = narrowed(search, &neighbors, &hidden);
        let found = stored.search(state, &narrowed)?.neighbors;
        merge(&mut neighbors, &found, search.k);
        hidden.push(&overlay.changed);
    }
    if known.is_none_or(|known| known.revision < snapshot.revision()) {
        let mut narrowed = narrowed(search, &neighbors, &hidden);
        let since = &mut narrowed.filter.since_revision;
        *since = known.map_or(0, |known| known.revision).max(*since);
        let found = snapshot.search(state, &narrowed)?.neighbors;
        merge(&mut neighbors, &found, search.k);
    }
    Ok(neighbors)
}

/// The search for what can still be among the nearest. The ball is closed: at equal distance a point precedes the
/// farthest one found if its id is smaller.
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
