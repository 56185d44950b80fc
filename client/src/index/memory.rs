//! The form of an index that lives in this process alone.

use std::{
    collections::HashMap,
    mem,
    sync::{Arc, Weak},
};

use parking_lot::{RwLock, RwLockReadGuard, RwLockUpgradableReadGuard, RwLockWriteGuard};
use wayfold_index::{
    Changes, NearestNeighbors, Neighbor, NewPoint, Point, ReadRevision, ScaledSearch,
    ScannedPoints, Space,
};

use super::{
    local::{self, LocalPoints, MAX_ID, NewRow, check_id},
    merger::{self, MergeOwner},
    origin::Origin,
};
use crate::Error;

/// An index in memory.
#[derive(Debug)]
pub(super) struct Memory {
    space: Space,
    state: RwLock<State>,
    merges: Merges,
    /// The process that made it: a lock may have been held at a fork, by a thread that is not in the new process.
    origin: Origin,
    /// Itself, for the merging thread.
    this: Weak<Memory>,
}

/// The thread that runs the merges.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Merges {
    /// The merging thread.
    Background,
    /// The thread whose change makes a merge due.
    Inline,
}

#[derive(Debug)]
struct State {
    points: LocalPoints,
    /// The next id that the index assigns: above every id it has used.
    next_id: u64,
    /// Only of points that have one.
    payloads: HashMap<u64, Vec<u8>>,
}

impl Memory {
    pub(super) fn new(space: &Space, merges: Merges) -> Arc<Memory> {
        let state = State {
            points: LocalPoints::new(space),
            next_id: 0,
            payloads: HashMap::new(),
        };
        Arc::new_cyclic(|this| Memory {
            space: space.clone(),
            state: RwLock::new(state),
            merges,
            origin: Origin::current(),
            this: this.clone(),
        })
    }

    fn read(&self) -> Result<RwLockReadGuard<'_, State>, Error> {
        self.origin.check()?;
        Ok(self.state.read())
    }

    fn write(&self) -> Result<RwLockWriteGuard<'_, State>, Error> {
        self.origin.check()?;
        Ok(self.state.write())
    }

    fn after_change(&self, points: &mut LocalPoints) {
        match self.merges {
            Merges::Background => merger::after_change(points, || self.this.clone()),
            Merges::Inline => points.settle(),
        }
    }
}

impl MergeOwner for Memory {
    fn with_points(&self, change: &mut dyn FnMut(&mut LocalPoints)) {
        change(&mut self.state.write().points);
    }
}

impl State {
    /// The next `count` ids.
    fn assign(&mut self, count: usize) -> Result<u64, Error> {
        let first = self.next_id;
        match first.checked_add(count as u64) {
            Some(next) if next <= MAX_ID + 1 => {
                self.next_id = next;
                Ok(first)
            }
            _ => Err(Error::Argument {
                field: "id",
                problem: "the index has used the greatest id".to_owned(),
            }),
        }
    }
}

impl NearestNeighbors for Memory {
    type Error = Error;

    fn space(&self) -> &Space {
        &self.space
    }

    fn len(&self) -> Result<usize, Error> {
        Ok(self.read()?.points.forest.len())
    }

    fn search(
        &self,
        row: &[f64],
        scaled: &ScaledSearch<'_>,
        found: &mut Vec<Neighbor>,
    ) -> Result<ReadRevision, Error> {
        let points = RwLockReadGuard::map(self.read()?, |state| &state.points);
        local::search(points, row, scaled, found)
    }

    fn search_many(
        &self,
        rows: &[f64],
        searches: &[ScaledSearch<'_>],
    ) -> Result<Vec<(Vec<Neighbor>, ReadRevision)>, Error> {
        let points = RwLockReadGuard::map(self.read()?, |state| &state.points);
        local::search_many(points, rows, searches)
    }

    fn insert(
        &self,
        point: &NewPoint<'_>,
        scaled: Option<&ScaledSearch<'_>>,
        found: &mut Vec<Neighbor>,
    ) -> Result<(u64, ReadRevision), Error> {
        check_id(point)?;
        found.clear();
        let mut state = match scaled {
            None => self.write()?,
            Some(scaled) => {
                self.origin.check()?;
                // Reads go on beside this guard, and only its holder changes the points.
                let state = self.state.upgradable_read();
                let search = state.points.among(scaled);
                *found = state.points.forest.search(point.row, &search)?.neighbors;
                RwLockUpgradableReadGuard::upgrade(state)
            }
        };
        if let Some(id) = point.id
            && state.points.forest.contains(id)
        {
            return Err(Error::IdTaken { id });
        }
        let id = match point.id {
            Some(id) => {
                state.next_id = state.next_id.max(id + 1);
                id
            }
            None => state.assign(1)?,
        };
        state.points.store(id, point.tag, point.row)?;
        if !point.payload.is_empty() {
            state.payloads.insert(id, point.payload.to_vec());
        }
        self.after_change(&mut state.points);
        Ok((id, state.points.read_revision()))
    }

    fn insert_many(&self, rows: &[f64]) -> Result<Vec<u64>, Error> {
        let rows = rows.chunks_exact(self.space.coordinates());
        let mut state = self.write()?;
        let first = state.next_id;
        let ids = first..first.saturating_add(rows.len() as u64);
        state.assign(rows.len())?;
        let stored = ids.clone().zip(rows);
        let stored = stored.map(|(id, row)| NewRow {
            id,
            tag: 0,
            row,
            is_new: true,
        });
        if let Err(error) = state.points.apply(stored, &[]) {
            state.next_id = first;
            return Err(error);
        }
        self.after_change(&mut state.points);
        Ok(ids.collect())
    }

    fn replace(&self, id: u64, row: &[f64]) -> Result<bool, Error> {
        let mut state = self.write()?;
        let Some(point) = state.points.get(id) else {
            return Ok(false);
        };
        state.points.store(id, point.tag, row)?;
        state.payloads.remove(&id);
        self.after_change(&mut state.points);
        Ok(true)
    }

    fn remove(&self, id: u64) -> Result<bool, Error> {
        let mut state = self.write()?;
        let removed = state.points.remove(id)?;
        state.payloads.remove(&id);
        self.after_change(&mut state.points);
        Ok(removed)
    }

    fn set_tag(&self, id: u64, tag: u64) -> Result<bool, Error> {
        let mut state = self.write()?;
        let is_stored = state.points.set_tag(id, tag)?;
        self.after_change(&mut state.points);
        Ok(is_stored)
    }

    fn set_payload(&self, id: u64, payload: &[u8]) -> Result<bool, Error> {
        let mut state = self.write()?;
        let is_stored = state.points.touch(id)?;
        match payload {
            [] => drop(state.payloads.remove(&id)),
            _ if is_stored => drop(state.payloads.insert(id, payload.to_vec())),
            _ => {}
        }
        self.after_change(&mut state.points);
        Ok(is_stored)
    }

    fn get(&self, id: u64) -> Result<Option<Point>, Error> {
        Ok(self.read()?.points.get(id))
    }

    fn payload(&self, id: u64) -> Result<Option<Vec<u8>>, Error> {
        let state = self.read()?;
        let is_stored = state.points.forest.contains(id);
        Ok(is_stored.then(|| state.payloads.get(&id).cloned().unwrap_or_default()))
    }

    fn scan(&self) -> Result<ScannedPoints<Error>, Error> {
        let snapshot = self.read()?.points.forest.snapshot();
        Ok(super::scan::scan(snapshot))
    }

    fn changes(&self, since: ReadRevision) -> Result<Option<Changes>, Error> {
        let points = RwLockReadGuard::map(self.read()?, |state| &state.points);
        Ok(local::changes(points, since))
    }

    fn clear(&self) -> Result<(), Error> {
        let mut state = self.write()?;
        let forest = state.points.clear()?;
        let payloads = mem::take(&mut state.payloads);
        drop(state);
        // Searches do not wait until these are freed.
        drop((forest, payloads));
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn insert(index: &Memory, row: &[f64], payload: &[u8]) {
        let point = NewPoint {
            id: None,
            tag: 0,
            row,
            payload,
        };
        index.insert(&point, None, &mut Vec::new()).unwrap();
    }

    #[test]
    fn inline_merges_leave_the_levels_of_the_plain_policy() {
        let index = Memory::new(&"R4".parse().unwrap(), Merges::Inline);
        for n in 0..3 * 8192u32 {
            let row = [15_199, 10_187, 18_003, 5_806].map(|factor| f64::from(n * factor % 24_593));
            insert(&index, &row, &[]);
        }
        // 16,384 points, 8,192, and the growing tree.
        assert_eq!(index.read().unwrap().points.forest.snapshot().trees(), 3);
    }

    #[test]
    fn the_levels_of_an_index_at_rest_are_packed_after_a_payload_changes_too() {
        let index = Memory::new(&"R1".parse().unwrap(), Merges::Background);
        insert(&index, &[0.5], &[]);
        index.with_points(&mut |points| points.is_watched = false);
        index.set_payload(0, b"edges").unwrap();
        index.with_points(&mut |points| assert!(points.is_watched));
    }

    #[test]
    fn a_cleared_index_keeps_no_room_for_payloads() {
        let index = Memory::new(&"R1".parse().unwrap(), Merges::Inline);
        insert(&index, &[0.5], b"edges");
        index.clear().unwrap();
        assert_eq!(index.read().unwrap().payloads.capacity(), 0);
    }
}
