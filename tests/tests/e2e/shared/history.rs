//! Writers through shared indices, and the history of their calls, of which every copy holds a prefix.

use std::{
    collections::{BTreeMap, BTreeSet},
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering::Relaxed},
        mpsc::{self, Receiver, SyncSender},
    },
    thread::{self, JoinHandle},
    time::Duration,
};

use rand::{RngExt, seq::IndexedRandom};
use wayfold::{Error, Index, InsertOptions, Meanwhile, Search};
use wayfold_index::{Filter, Linear, PointRef, Space};
use wayfold_tests::{
    States, bits,
    brute_force::{self, pairs},
};

/// A point's tag and the bits of its state.
type Point = (u64, Vec<u64>);

/// Points by id.
pub(super) type Content = BTreeMap<u64, Point>;

/// The point under an id after a call.
type Change = (u64, Option<Point>);

/// The first of the ids that the writers choose themselves.
const CHOSEN_IDS: u64 = 1 << 40;
/// The last of them. Once it is stored, the server assigns only greater ones.
const LAST_CHOSEN_ID: u64 = CHOSEN_IDS + 999;
/// The ids that all writers change.
const COMMON_IDS: u64 = 16;
/// The ids that one writer chooses.
const OWN_IDS: u64 = 8;

/// The points of an index.
pub(super) fn content(index: &Index) -> Content {
    let points = index.scan().unwrap().map(Result::unwrap);
    points
        .map(|point| (point.id, (point.tag, bits(&point.state))))
        .collect()
}

/// Waits until copies have seen everything that the server has taken so far, by a last point.
pub(super) fn wait_for_all(marker: &Index, state: &[f64], copies: &[&Index]) {
    let id = marker.insert(state).unwrap();
    marker.flush().unwrap();
    for copy in copies {
        while copy.get(id).unwrap().is_none() {
            thread::yield_now();
        }
    }
}

/// Waits until no search is open, and returns the answers that came after the inserts.
pub(super) fn take_answers(index: &Index) -> Vec<Meanwhile> {
    let mut answers = Vec::new();
    loop {
        let taken = index.wait_meanwhile(Duration::from_secs(60));
        assert!(!taken.has_dropped);
        answers.extend(taken.answers);
        if taken.open == 0 {
            return answers;
        }
    }
}

/// Starts a writer of each index, which writes whenever a turn is received.
pub(super) fn start_writers(indexes: &[Index]) -> (Receiver<()>, Vec<JoinHandle<History>>) {
    let (turn, turns) = mpsc::sync_channel(0);
    let writers = (0..).zip(indexes).map(|(number, index)| {
        let (writer, turn) = (Writer::new(index.clone(), number), turn.clone());
        thread::spawn(move || writer.run(&turn))
    });
    (turns, writers.collect())
}

/// One writer: its calls change its own points, which no one else changes, and the common ones.
struct Writer {
    index: Index,
    states: States,
    /// The point whose tag counts the turns.
    clock: u64,
    turns: u64,
    /// The ids that the writer chose and that are not stored now.
    chosen: Vec<u64>,
    mine: Vec<u64>,
    points: Content,
    history: History,
}

/// The changes of one writer to its own points, in the order of its calls.
#[derive(Default)]
pub(super) struct History {
    clock: u64,
    changes: Vec<Change>,
    /// The ids that the index assigned.
    pub(super) assigned: Vec<u64>,
}

impl Writer {
    fn new(index: Index, number: u64) -> Writer {
        let first = CHOSEN_IDS + COMMON_IDS + number * OWN_IDS;
        let mut writer = Writer {
            states: States::new(index.space().clone(), 10 + number),
            index,
            clock: 0,
            turns: 0,
            chosen: (first..first + OWN_IDS).collect(),
            mine: Vec::new(),
            points: Content::new(),
            history: History::default(),
        };
        let state = writer.states.row();
        writer.clock = writer.index.insert(&state[..]).unwrap();
        writer.history.clock = writer.clock;
        writer.history.assigned.push(writer.clock);
        writer.record(writer.clock, Some((0, &state)));
        writer
    }

    /// Writes whenever `turn` is taken, until it is gone. Returns what it did once the server has acknowledged it.
    fn run(mut self, turn: &SyncSender<()>) -> History {
        while turn.send(()).is_ok() {
            self.write();
            self.write_common();
            self.turns += 1;
            let state = self.index.get(self.clock).unwrap().unwrap().state;
            assert!(self.index.set_tag(self.clock, self.turns).unwrap());
            self.record(self.clock, Some((self.turns, &state)));
        }
        self.index.flush().unwrap();
        assert_eq!(self.index.pending(), 0);
        self.history
    }

    /// Makes one call on own points, which the copy shows at once.
    fn write(&mut self) {
        let state = self.states.row();
        let tag = self.states.rng().random_range(0..1_000);
        let kind = self.states.rng().random_range(0..12);
        let own = self.mine.choose(self.states.rng()).copied();
        match (kind, own) {
            (0 | 1, Some(id)) => {
                assert!(self.index.remove(id).unwrap());
                self.mine.retain(|mine| *mine != id);
                if (CHOSEN_IDS..=LAST_CHOSEN_ID).contains(&id) {
                    self.chosen.push(id);
                }
                self.record(id, None);
            }
            (2 | 3, Some(id)) => {
                let tag = self.points[&id].0;
                assert!(self.index.replace(id, &state[..]).unwrap());
                self.record(id, Some((tag, &state)));
            }
            (4 | 5, Some(id)) => {
                let state = self.index.get(id).unwrap().unwrap().state;
                assert!(self.index.set_tag(id, tag).unwrap());
                self.record(id, Some((tag, &state)));
            }
            (6, _) => {
                let rows = self.states.rows(3);
                let width = self.index.space().coordinates();
                let ids = self.index.insert_many(rows.chunks(width)).unwrap();
                for (&id, row) in ids.iter().zip(rows.chunks(width)) {
                    self.stored(id, 0, row);
                }
            }
            (7, _) if !self.chosen.is_empty() => {
                let id = self.chosen.remove(0);
                let options = InsertOptions::new().id(id).tag(tag);
                self.index.insert_with(&state[..], options).unwrap();
                self.mine.push(id);
                self.record(id, Some((tag, &state)));
            }
            _ => {
                let options = InsertOptions::new().tag(tag);
                let inserted = self.index.insert_with(&state[..], options).unwrap();
                self.stored(inserted.id, tag, &state);
            }
        }
    }

    /// Makes one call on a point that others change too.
    fn write_common(&mut self) {
        let state = self.states.row();
        let random = self.states.rng();
        let id = CHOSEN_IDS + random.random_range(0..COMMON_IDS);
        match random.random_range(0..8) {
            0 => drop(self.index.remove(id).unwrap()),
            1 => drop(self.index.replace(id, &state[..]).unwrap()),
            2 => drop(self.index.set_tag(id, self.turns).unwrap()),
            3 => {
                let options = InsertOptions::new().id(id);
                match self.index.insert_with(&state[..], options) {
                    Ok(_) | Err(Error::IdTaken { .. }) => {}
                    Err(error) => panic!("{error}"),
                }
            }
            _ => {}
        }
    }

    fn stored(&mut self, id: u64, tag: u64, state: &[f64]) {
        self.mine.push(id);
        self.history.assigned.push(id);
        self.record(id, Some((tag, state)));
    }

    /// Notes what a call did, and asserts that the copy shows it.
    fn record(&mut self, id: u64, to: Option<(u64, &[f64])>) {
        let to = to.map(|(tag, state)| {
            let mut state = state.to_vec();
            self.index.space().canonicalize(&mut state).unwrap();
            (tag, bits(&state))
        });
        let shown = self.index.get(id).unwrap();
        assert_eq!(shown.map(|point| (point.tag, bits(&point.state))), to);
        apply(&mut self.points, &(id, to.clone()));
        self.history.changes.push((id, to));
    }
}

fn apply(points: &mut Content, change: &Change) {
    match &change.1 {
        Some(content) => points.insert(change.0, content.clone()),
        None => points.remove(&change.0),
    };
}

impl History {
    /// The own points after all calls.
    pub(super) fn points(&self) -> Content {
        let mut points = Content::new();
        self.changes
            .iter()
            .for_each(|change| apply(&mut points, change));
        points
    }

    /// Asserts that each of these contents of one copy, in their order, holds the effect of a prefix of the calls,
    /// which never becomes shorter.
    pub(super) fn check_prefixes<'a>(&self, contents: impl IntoIterator<Item = &'a Content>) {
        let ids: BTreeSet<u64> = self.changes.iter().map(|change| change.0).collect();
        let mut changes = self.changes.iter().peekable();
        let mut points = Content::new();
        for content in contents {
            let shown = content.iter().filter(|(id, _)| ids.contains(id));
            let shown: Content = shown.map(|(id, point)| (*id, point.clone())).collect();
            while points.get(&self.clock) != shown.get(&self.clock) {
                let change = changes.next().expect("a turn that was, in their order");
                apply(&mut points, change);
            }
            while points != shown {
                let change = changes.next_if(|change| change.0 != self.clock);
                apply(&mut points, change.expect("a prefix of the calls"));
            }
        }
    }
}

/// Compares answers of an index with brute force over its points, at random moments until `done`. Returns how many were
/// compared. An answer counts if the copy has not changed between it and the scan of the points.
pub(super) fn check_meanwhile(index: &Index, done: &AtomicBool, seed: u64) -> u64 {
    let mut states = States::new(index.space().clone(), seed);
    let mut compared = 0;
    loop {
        let is_last = done.load(Relaxed);
        let state = states.row();
        let k = states.rng().random_range(1..20);
        let mask = states.rng().random_range(0..4);
        let value = mask & states.rng().random_range(0..4);
        let query = Search::k(k).tag(mask, value);
        let found = index.search(&state[..], &query).unwrap();
        let points = points_of(index);
        let again = index.search(&state[..], &query).unwrap();
        if again.read_revision == found.read_revision {
            let filter = Filter {
                tag_mask: mask,
                tag_value: value,
                ..Filter::default()
            };
            let query = wayfold_index::Search {
                filter,
                ..wayfold_index::Search::nearest_k(k as usize)
            };
            let expected = brute_force::search(&points, &state, &query);
            assert_eq!(
                pairs(found.neighbors),
                expected,
                "k {k}, tag {mask} {value}"
            );
            compared += 1;
        }
        if is_last {
            return compared;
        }
    }
}

/// The points of an index, for brute force.
fn points_of(index: &Index) -> Linear {
    let mut points = Linear::new(index.space().clone());
    for point in index.scan().unwrap() {
        let point = point.unwrap();
        let point = PointRef {
            id: point.id,
            tag: point.tag,
            revision: 0,
            row: &point.state,
        };
        points.insert(point).unwrap();
    }
    points
}

/// Asserts that an index answers like brute force over its points.
pub(super) fn check_answers(index: &Index, space: &Space, seed: u64) {
    let points = points_of(index);
    assert_eq!(index.len().unwrap(), points.len());
    let mut states = States::new(space.clone(), seed);
    for _ in 0..20 {
        let state = states.row();
        let k = states.rng().random_range(1..20);
        let search = wayfold_index::Search::nearest_k(k as usize);
        let expected = brute_force::search(&points, &state, &search);
        let found = index.search(&state[..], &Search::k(k)).unwrap();
        assert_eq!(pairs(found.neighbors), expected);
    }
}

/// Asserts that all copies hold the points of `expected`, and answer like brute force.
pub(super) fn check_copies(expected: &Content, space: &Space, copies: &[&Index]) {
    for (seed, copy) in copies.iter().enumerate() {
        assert_eq!(content(copy), *expected, "copy {seed}");
        assert_eq!(copy.pending(), 0);
        check_answers(copy, space, seed as u64);
    }
}

/// The ids that all writers change, stored.
pub(super) fn store_common(index: &Index, seed: u64) -> Arc<[u64]> {
    let mut states = States::new(index.space().clone(), seed);
    let ids: Arc<[u64]> = (CHOSEN_IDS..CHOSEN_IDS + COMMON_IDS)
        .chain([LAST_CHOSEN_ID])
        .collect();
    for &id in &*ids {
        let options = InsertOptions::new().id(id);
        index.insert_with(&states.row()[..], options).unwrap();
    }
    index.flush().unwrap();
    ids
}
