//! A brute-force model of an index, and random histories that compare the two.

mod searches;
mod states;

use std::collections::{BTreeMap, HashMap, HashSet};

use rand::{RngExt, SeedableRng, seq::IndexedRandom};
use rand_chacha::ChaCha8Rng;
use wayfold::{Changes, Error, Index, InsertOptions, Neighbor, ReadRevision};
use wayfold_index::{Linear, PointRef};

/// The greatest number of steps that [`Changes`] reach back.
const MAX_CHANGES: usize = 1 << 16;

/// An index, and what brute force says that it holds.
pub(crate) struct Model {
    pub(crate) index: Index,
    rng: ChaCha8Rng,
    points: Linear,
    payloads: HashMap<u64, Vec<u8>>,
    /// The number of changes.
    changes: u64,
    /// The ids that changed, with the number of the change.
    history: Vec<(u64, u64)>,
    /// The tokens of answers, with the number of changes then.
    read_revisions: Vec<(ReadRevision, u64)>,
    used_ids: HashSet<u64>,
    last_assigned: Option<u64>,
}

impl Model {
    /// A model of an index that is empty.
    pub(crate) fn new(index: Index, seed: u64) -> Model {
        Model {
            points: Linear::new(index.space().clone()),
            rng: ChaCha8Rng::seed_from_u64(seed),
            index,
            payloads: HashMap::new(),
            changes: 0,
            history: Vec::new(),
            read_revisions: Vec::new(),
            used_ids: HashSet::new(),
            last_assigned: None,
        }
    }

    /// Random operations, each answer compared with brute force.
    pub(crate) fn run(&mut self, steps: usize) {
        for _ in 0..steps {
            match self.rng.random_range(0..21) {
                0..=5 => self.insert(),
                6 => self.insert_with_an_id(),
                7 => self.insert_many(),
                8 => self.remove(),
                9 => self.replace(),
                10 => self.set_tag(),
                11 => self.get(),
                12 => self.set_payload(),
                13 => self.search_many(),
                14 => self.changed(),
                15..=20 => self.search(),
                _ => unreachable!(),
            }
        }
        self.scan();
    }

    /// An id that is stored, most times.
    fn some_id(&mut self) -> u64 {
        let ids: Vec<u64> = self.points.iter().map(|point| point.id).collect();
        match ids.choose(&mut self.rng) {
            Some(&id) if self.rng.random_bool(0.9) => id,
            // Far from the ids that an index assigns.
            _ => (1 << 40) + self.rng.random_range(0..2_000),
        }
    }

    /// An id that a call may name; no point can have some.
    fn named_id(&mut self) -> u64 {
        match self.rng.random_bool(0.05) {
            true => (1 << 63) + self.rng.random_range(0..2),
            false => self.some_id(),
        }
    }

    fn store(&mut self, id: u64, tag: u64, row: &[f64], revision: u64) {
        self.history.push((self.changes, id));
        let point = PointRef {
            id,
            tag,
            revision,
            row,
        };
        self.points.insert(point).unwrap();
    }

    /// Notes an id that the index assigned.
    fn assigned(&mut self, id: u64) {
        assert!(self.used_ids.insert(id), "id {id} was used");
        assert!(
            self.last_assigned < Some(id),
            "{id} after {:?}",
            self.last_assigned
        );
        self.last_assigned = Some(id);
    }

    fn insert(&mut self) {
        let state = self.state();
        let row = self.canonical(&state);
        self.changes += 1;
        if self.rng.random_bool(0.3) {
            let id = self.index.insert(&state[..]).unwrap();
            self.assigned(id);
            self.store(id, 0, &row, self.changes);
            return;
        }
        let (tag, payload) = (self.rng.random_range(0..4), self.payload());
        let (search, expected) = self.question(&row);
        let options = InsertOptions::new()
            .tag(tag)
            .payload(&payload)
            .neighbors(search);
        let inserted = self.index.insert_with(&state[..], options).unwrap();
        assert_same(&inserted.neighbors.neighbors, &expected);
        self.read_revisions
            .push((inserted.neighbors.read_revision, self.changes));
        self.assigned(inserted.id);
        self.store(inserted.id, tag, &row, self.changes);
        self.payloads.insert(inserted.id, payload);
    }

    fn payload(&mut self) -> Vec<u8> {
        let bytes = self.rng.random_range(0..3);
        vec![self.rng.random(); bytes]
    }

    fn insert_with_an_id(&mut self) {
        let (state, id) = (self.state(), self.some_id());
        let inserted = self
            .index
            .insert_with(&state[..], InsertOptions::new().id(id));
        if self.points.get(id).is_some() {
            assert!(
                matches!(inserted, Err(Error::IdTaken { id: taken }) if taken == id),
                "{inserted:?}"
            );
            return;
        }
        assert_eq!(inserted.unwrap().id, id);
        self.changes += 1;
        self.used_ids.insert(id);
        let row = self.canonical(&state);
        self.store(id, 0, &row, self.changes);
    }

    fn insert_many(&mut self) {
        let count = self.rng.random_range(0..40);
        let states: Vec<Vec<f64>> = (0..count).map(|_| self.state()).collect();
        let ids = self.index.insert_many(&states).unwrap();
        assert_eq!(ids.len(), count);
        self.changes += 1;
        for (id, state) in ids.into_iter().zip(&states) {
            self.assigned(id);
            let row = self.canonical(state);
            self.store(id, 0, &row, self.changes);
        }
    }

    fn remove(&mut self) {
        let id = self.named_id();
        let removed = self.index.remove(id).unwrap();
        assert_eq!(removed, self.points.remove(id));
        self.payloads.remove(&id);
        if removed {
            self.changes += 1;
            self.history.push((self.changes, id));
        }
    }

    fn replace(&mut self) {
        let (id, state) = (self.named_id(), self.state());
        let row = self.canonical(&state);
        if self.points.get(id).is_some_and(|point| point.row == row) {
            // The forms differ in whether that is a change.
            return;
        }
        let replaced = self.index.replace(id, &state[..]).unwrap();
        let tag = self.points.get(id).map(|point| point.tag);
        assert_eq!(replaced, tag.is_some());
        if let Some(tag) = tag {
            self.changes += 1;
            self.payloads.remove(&id);
            self.store(id, tag, &row, self.changes);
        }
    }

    fn set_tag(&mut self) {
        let (id, tag) = (self.named_id(), self.rng.random_range(0..4));
        let is_stored = self.index.set_tag(id, tag).unwrap();
        let point = self.points.get(id).map(PointRef::to_point);
        assert_eq!(is_stored, point.is_some());
        if let Some(point) = point.filter(|point| point.tag != tag) {
            self.changes += 1;
            self.store(id, tag, &point.row, point.revision);
        }
    }

    fn set_payload(&mut self) {
        let (id, payload) = (self.named_id(), self.payload());
        let old = self.payloads.get(&id).cloned().unwrap_or_default();
        if old == payload {
            // The forms differ in whether that is a change.
            return;
        }
        let is_stored = self.index.set_payload(id, &payload).unwrap();
        assert_eq!(is_stored, self.points.get(id).is_some());
        if is_stored {
            self.changes += 1;
            self.history.push((self.changes, id));
            self.payloads.insert(id, payload);
        }
    }

    fn get(&mut self) {
        let id = self.named_id();
        let found = self.index.get(id).unwrap();
        let found = found
            .as_ref()
            .map(|point| (point.id, point.tag, &point.state[..]));
        let expected = self
            .points
            .get(id)
            .map(|point| (point.id, point.tag, point.row));
        assert_eq!(found, expected);
        let payload = self
            .points
            .get(id)
            .map(|_| self.payloads.get(&id).cloned().unwrap_or_default());
        assert_eq!(self.index.payload(id).unwrap(), payload);
        let ids = [id, self.named_id(), id, self.named_id()];
        let payloads = ids.iter().map(|&id| {
            let stored = self.points.get(id);
            stored.map(|_| self.payloads.get(&id).cloned().unwrap_or_default())
        });
        assert_eq!(self.index.payloads(&ids).unwrap(), Vec::from_iter(payloads));
    }

    fn changed(&mut self) {
        let Some(&(since, number)) = self.read_revisions.choose(&mut self.rng) else {
            return;
        };
        let Changes {
            stored,
            removed,
            read_revision,
        } = self.index.changes(since).unwrap().unwrap();
        assert!(self.history.len() < MAX_CHANGES);
        let newer = self.history.iter().filter(|(at, _)| *at > number);
        let ids: BTreeMap<u64, bool> = newer
            .map(|&(_, id)| (id, self.points.get(id).is_some()))
            .collect();
        let found = stored.iter().map(|point| (point.id, true));
        let found: BTreeMap<u64, bool> =
            found.chain(removed.iter().map(|&id| (id, false))).collect();
        assert_eq!(found, ids);
        assert_eq!(stored.len() + removed.len(), ids.len());
        for point in &stored {
            let expected = self.points.get(point.id).unwrap();
            assert_eq!((point.tag, &point.state[..]), (expected.tag, expected.row));
        }
        self.read_revisions.push((read_revision, self.changes));
    }

    /// Compares all points.
    pub(crate) fn scan(&self) {
        let scanned: Vec<_> = self.index.scan().unwrap().map(Result::unwrap).collect();
        assert!(scanned.is_sorted_by(|a, b| a.id < b.id));
        assert_eq!(scanned.len(), self.points.len());
        for point in &scanned {
            let expected = self.points.get(point.id).unwrap();
            assert_eq!((point.tag, &point.state[..]), (expected.tag, expected.row));
        }
    }
}

/// Compares ids and the bits of distances.
#[track_caller]
pub(crate) fn assert_same(found: &[Neighbor], expected: &[Neighbor]) {
    let bits = |neighbors: &[Neighbor]| -> Vec<(u64, u64)> {
        let pairs = neighbors.iter();
        pairs
            .map(|neighbor| (neighbor.id, neighbor.distance.to_bits()))
            .collect()
    };
    assert_eq!(bits(found), bits(expected));
}
