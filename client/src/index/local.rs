//! The points that an index holds in this process.

use std::{collections::HashSet, ops::Deref};

use wayfold_index::{
    Changes, Forest, ForestOptions, Merge, Neighbor, NewPoint, Point, PointRef, Points,
    ReadRevision, ScaledSearch, Search, Space,
};

use super::history::History;
use crate::Error;

/// A merge is looked for after this many changes: looking costs as much as a small insert.
const MERGE_INTERVAL: usize = 64;

/// Searches for more neighbours than this read a snapshot, so that writers do not wait for them.
const MAX_LOCKED_K: usize = 256;

/// More changed points than this are copied from a snapshot, so that writers do not wait for it.
const MAX_LOCKED_CHANGES: usize = 256;

/// A forest, and the order in which its changes became visible here. The forest's revisions are those changes.
#[derive(Debug)]
pub(super) struct LocalPoints {
    pub(super) forest: Forest,
    history: History,
    /// A table of one row, used again by each change of one point.
    one: Points,
    /// The rows that changed since the last look for a merge.
    unmerged: usize,
    /// True if the merging thread looks for a pause in the changes.
    pub(super) is_watched: bool,
}

impl LocalPoints {
    pub(super) fn new(space: &Space) -> LocalPoints {
        LocalPoints {
            forest: Forest::new(space.clone(), ForestOptions::for_space(space)),
            history: History::default(),
            one: Points::with_capacity(space.coordinates(), 1),
            unmerged: 0,
            is_watched: false,
        }
    }

    /// The last change.
    pub(super) fn read_revision(&self) -> ReadRevision {
        ReadRevision(self.forest.revision())
    }

    /// Stores one point, in place of one with the same id.
    pub(super) fn store(&mut self, id: u64, tag: u64, row: &[f64]) -> Result<(), Error> {
        let change = self.forest.revision() + 1;
        self.store_as_of(id, tag, change, row)
    }

    /// Sets the tag of a point; false if there is none with this id.
    pub(super) fn set_tag(&mut self, id: u64, tag: u64) -> Result<bool, Error> {
        let Some(point) = self.forest.get(id) else {
            return Ok(false);
        };
        if point.tag != tag {
            self.store_as_of(id, tag, point.revision, &point.row)?;
        }
        Ok(true)
    }

    /// Notes that something of a point changed that is not held here; false if there is none with this id.
    pub(super) fn touch(&mut self, id: u64) -> Result<bool, Error> {
        if !self.forest.contains(id) {
            return Ok(false);
        }
        self.one.clear();
        let change = self.forest.revision() + 1;
        self.forest.apply(change, &self.one, &[])?;
        self.history.push(change, id);
        Ok(true)
    }

    /// Stores one point whose state was stored by change number `stored_at`.
    fn store_as_of(&mut self, id: u64, tag: u64, stored_at: u64, row: &[f64]) -> Result<(), Error> {
        self.one.clear();
        self.one.push_point(PointRef {
            id,
            tag,
            revision: stored_at,
            row,
        });
        let change = self.forest.revision() + 1;
        self.forest.apply(change, &self.one, &[])?;
        self.history.push(change, id);
        self.unmerged += 1;
        Ok(())
    }

    /// Removes a point; false if there is none with this id.
    pub(super) fn remove(&mut self, id: u64) -> Result<bool, Error> {
        if !self.forest.contains(id) {
            return Ok(false);
        }
        self.one.clear();
        let change = self.forest.revision() + 1;
        self.forest.apply(change, &self.one, &[id])?;
        self.history.push(change, id);
        self.unmerged += 1;
        Ok(true)
    }

    /// Removes the points with the ids `removed`, then stores rows as one change, each in place of one with the same
    /// id.
    pub(super) fn apply<'a>(
        &mut self,
        stored: impl Iterator<Item = NewRow<'a>>,
        removed: &[u64],
    ) -> Result<(), Error> {
        let change = self.forest.revision() + 1;
        let (width, rows) = (self.forest.space().coordinates(), stored.size_hint().0);
        let mut points = Points::with_capacity(width, rows);
        for NewRow {
            id,
            tag,
            row,
            is_new,
        } in stored
        {
            let held = if is_new { None } else { self.forest.get(id) };
            points.push(id, tag, held.map_or(change, |held| held.revision), row);
        }
        self.forest.apply(change, &points, removed)?;
        for &id in points.ids().iter().chain(removed) {
            self.history.push(change, id);
        }
        self.unmerged += points.len() + removed.len();
        Ok(())
    }

    /// Removes all points. Returns the old forest, which takes long to drop.
    pub(super) fn clear(&mut self) -> Result<Forest, Error> {
        let space = self.forest.space().clone();
        let mut empty = Forest::new(space.clone(), ForestOptions::for_space(&space));
        let change = self.forest.revision() + 1;
        empty.apply(change, &Points::new(space.coordinates()), &[])?;
        Ok(self.replace(empty))
    }

    /// Replaces all points by those of `forest`, whose revision is above that of this one. Returns the old forest,
    /// which takes long to drop.
    pub(super) fn replace(&mut self, forest: Forest) -> Forest {
        self.history.forget(forest.revision());
        self.unmerged = MERGE_INTERVAL;
        std::mem::replace(&mut self.forest, forest)
    }

    /// The next merge, if one is due.
    pub(super) fn merge(&mut self) -> Option<Merge> {
        if self.unmerged < MERGE_INTERVAL {
            return None;
        }
        let merge = self.forest.begin_merge();
        if merge.is_none() {
            self.unmerged = 0;
        }
        merge
    }

    /// Runs the due merges on this thread. Those that wait for a pause do not run: they would double the rebuilds of a
    /// point.
    pub(super) fn settle(&mut self) {
        if self.unmerged >= MERGE_INTERVAL {
            self.forest.settle();
            self.unmerged = 0;
        }
    }

    /// The search among the present points.
    pub(super) fn among<'a>(&self, scaled: &ScaledSearch<'a>) -> Search<'a> {
        scaled.among(self.forest.len(), self.forest.space().dimension())
    }

    pub(super) fn get(&self, id: u64) -> Option<Point> {
        self.forest.get(id)
    }
}

/// One row to store.
#[derive(Clone, Copy, Debug)]
pub(super) struct NewRow<'a> {
    pub(super) id: u64,
    pub(super) tag: u64,
    pub(super) row: &'a [f64],
    /// False if the point is stored with this state, and only its tag or its payload is new.
    pub(super) is_new: bool,
}

/// Answers a search of the points. One that would keep writers waiting reads a snapshot, without the lock.
pub(super) fn search(
    points: impl Deref<Target = LocalPoints>,
    row: &[f64],
    scaled: &ScaledSearch<'_>,
    found: &mut Vec<Neighbor>,
) -> Result<ReadRevision, Error> {
    let (search, read_revision) = (points.among(scaled), points.read_revision());
    let answer = match search.k > MAX_LOCKED_K || search.until.is_some() {
        false => points.forest.search(row, &search),
        true => {
            let snapshot = points.forest.snapshot();
            drop(points);
            snapshot.search(row, &search)
        }
    };
    *found = answer?.neighbors;
    Ok(read_revision)
}

/// Answers the searches in turn, one a row, in a snapshot of the points.
pub(super) fn search_many(
    points: impl Deref<Target = LocalPoints>,
    rows: &[f64],
    searches: &[ScaledSearch<'_>],
) -> Result<Vec<(Vec<Neighbor>, ReadRevision)>, Error> {
    let (snapshot, read_revision) = (points.forest.snapshot(), points.read_revision());
    drop(points);
    let rows = rows.chunks_exact(snapshot.space().coordinates());
    rows.zip(searches.iter().cycle())
        .map(|(row, scaled)| {
            let search = scaled.among(snapshot.len(), snapshot.space().dimension());
            Ok((snapshot.search(row, &search)?.neighbors, read_revision))
        })
        .collect()
}

/// The points that changed after the revision `since`, as they are now; None if the index no longer knows.
pub(super) fn changes(
    points: impl Deref<Target = LocalPoints>,
    since: ReadRevision,
) -> Option<Changes> {
    let ids = points.history.after(since)?;
    let changes = Changes {
        stored: Points::new(points.forest.space().coordinates()),
        removed: Vec::new(),
        read_revision: points.read_revision(),
    };
    if ids.len() <= MAX_LOCKED_CHANGES {
        return Some(with_points(changes, ids, |id| points.forest.get(id)));
    }
    let snapshot = points.forest.snapshot();
    drop(points);
    Some(with_points(changes, ids, |id| snapshot.get(id)))
}

/// Adds the points with these ids, each once.
fn with_points(mut changes: Changes, ids: Vec<u64>, get: impl Fn(u64) -> Option<Point>) -> Changes {
    let mut known = HashSet::new();
    for id in ids.into_iter().filter(|&id| known.insert(id)) {
        match get(id) {
            Some(point) => changes.stored.push_point(point.by_ref()),
            None => changes.removed.push(id),
        }
    }
    changes
}

/// Refuses an id that no index takes.
pub(super) fn check_id(point: &NewPoint<'_>) -> Result<(), Error> {
    match point.id {
        Some(id) if id > MAX_ID => Err(Error::Argument {
            field: "id",
            problem: format!("{id}; ids are below 2^63"),
        }),
        _ => Ok(()),
    }
}

/// The greatest id.
pub(super) const MAX_ID: u64 = (1 << 63) - 1;

#[cfg(test)]
mod tests {
    use super::*;

    /// A few points are copied under the lock, and many from a snapshot.
    #[test]
    fn a_point_that_changed_twice_is_told_once_as_it_is_now() {
        for count in [2, 2 * MAX_LOCKED_CHANGES as u64] {
            let mut points = LocalPoints::new(&"R1".parse().unwrap());
            for id in 0..count {
                points.store(id, 0, &[id as f64]).unwrap();
            }
            points.set_tag(0, 7).unwrap();
            points.remove(1).unwrap();
            let changes = changes(&points, ReadRevision(0)).unwrap();
            assert_eq!(changes.read_revision, points.read_revision());
            assert_eq!(changes.removed, [1]);
            let mut told: Vec<_> = changes.stored.iter().map(|it| (it.id, it.tag)).collect();
            told.sort_unstable();
            let others = (2..count).map(|id| (id, 0));
            assert!(told.into_iter().eq([(0, 7)].into_iter().chain(others)));
        }
    }
}
