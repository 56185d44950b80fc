//! Writers, and the history of their mutations, with which every answer of a replica is compared.

use std::{
    collections::BTreeMap,
    sync::atomic::{AtomicBool, Ordering},
    time::Duration,
};

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use wayfold::{Client, IndexHandle, Replica, ReplicaNeighbors, RetryPolicy};
use wayfold_index::{Filter, Linear, PointRef, Search, Space};
use wayfold_tests::{
    States, bits,
    brute_force::{self, pairs},
};

/// The effect of one mutation.
pub(super) enum Change {
    Stored {
        ids: Vec<u64>,
        rows: Vec<f64>,
        tag: u64,
    },
    Tagged {
        ids: Vec<u64>,
        tag: u64,
    },
    Removed {
        ids: Vec<u64>,
    },
}

/// The changes, by the revision that each made.
pub(super) type History = BTreeMap<u64, Change>;

/// A search and the answer of a replica.
pub(super) struct ReplicaAnswer {
    pub(super) state: Vec<f64>,
    pub(super) question: Question,
    pub(super) found: ReplicaNeighbors,
}

/// A client that waits for its server without a limit.
pub(super) async fn client(uri: &str) -> Client {
    let patient = Client::builder()
        .timeout(Duration::from_secs(120))
        .retry(RetryPolicy::until_deadline());
    patient.connect(uri).await.unwrap()
}

/// Makes `calls` mutations of its own points; each changes something.
pub(super) async fn write(index: IndexHandle, name: u64, calls: u64) -> History {
    let mut random = ChaCha8Rng::seed_from_u64(100 + name);
    let mut states = States::new(index.space().clone(), name);
    let mut mine: Vec<u64> = Vec::new();
    let mut past = History::new();
    for call in 0..calls {
        // No two mutations give the same tag.
        let tag = call << 8 | name << 4 | random.random_range(0..16);
        let few = random.random_range(1..=5).min(mine.len());
        let (revision, change) = match random.random_range(0..10) {
            0 | 1 if few > 0 => {
                let ids = mine.split_off(mine.len() - few);
                let removed = index.remove(ids.clone()).await.unwrap();
                (removed.revision.number, Change::Removed { ids })
            }
            2 | 3 if few > 0 => {
                let ids = mine[..few].to_vec();
                let updated = index.update(ids.clone()).tags([tag]).await.unwrap();
                (updated.revision.number, Change::Tagged { ids, tag })
            }
            kind => {
                // Some rows are already stored, and some calls exceed a message of the feed.
                let count = if call % 50 == 17 {
                    6_000
                } else {
                    random.random_range(1..=20)
                };
                let first = match kind {
                    4 => name << 32,
                    _ => name << 32 | call << 16,
                };
                let ids: Vec<u64> = (first..first + count).collect();
                let rows = states.rows(ids.len());
                let width = index.coordinates();
                let insert = index.insert(rows.chunks(width)).ids(ids.clone());
                let insert = insert.tags(vec![tag; ids.len()]);
                let inserted = insert.replace().await.unwrap();
                mine.retain(|id| !ids.contains(id));
                mine.extend(&ids);
                (inserted.revision.number, Change::Stored { ids, rows, tag })
            }
        };
        assert!(past.insert(revision, change).is_none());
    }
    past
}

/// A search that both brute force and a replica can make.
#[derive(Clone, Copy, Debug)]
pub(super) struct Question {
    /// Without it, all within the radius.
    k: Option<u32>,
    radius: f64,
    filter: Filter,
}

impl Question {
    /// For brute force.
    pub(super) fn plain(&self) -> Search<'static> {
        Search {
            radius: self.radius,
            filter: self.filter,
            ..Search::nearest_k(self.k.map_or(usize::MAX, |k| k as usize))
        }
    }

    /// For a replica of this index.
    pub(super) fn of(&self, index: &IndexHandle) -> wayfold::ReplicaSearch {
        let search = match self.k {
            Some(k) => wayfold::ReplicaSearch::k(k).radius(self.radius),
            None => wayfold::ReplicaSearch::within(self.radius),
        };
        let Filter {
            tag_mask,
            tag_value,
            since_revision,
        } = self.filter;
        let filter = wayfold::Filter::default().tag(tag_mask, tag_value);
        search.filter(match since_revision {
            0 => filter,
            since => filter.since(index.revision_at(since)),
        })
    }
}

/// Draws a search of any kind, with a filter that excludes some points.
pub(super) fn question(random: &mut ChaCha8Rng, revision: u64) -> Question {
    let (k, radius) = match random.random_range(0..3) {
        0 => (Some(1), f64::INFINITY),
        1 => (Some(random.random_range(2..20)), f64::INFINITY),
        _ => (None, random.random_range(0.0..1.5)),
    };
    let filter = match random.random_range(0..3) {
        0 => Filter::default(),
        1 => Filter {
            tag_mask: 3,
            tag_value: random.random_range(0..4),
            ..Filter::default()
        },
        _ => Filter {
            since_revision: revision / 2,
            ..Filter::default()
        },
    };
    Question { k, radius, filter }
}

/// Searches until `stop` is set; keeps at most one answer for each revision.
pub(super) fn ask(
    replica: &Replica,
    space: Space,
    seed: u64,
    stop: &AtomicBool,
) -> Vec<ReplicaAnswer> {
    let mut states = States::new(space, 1_000 + seed);
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut answers: Vec<ReplicaAnswer> = Vec::new();
    while !stop.load(Ordering::Relaxed) {
        let state = states.row();
        let question = question(&mut random, replica.revision().number);
        let search = question.of(&replica.index());
        let found = replica.search(&state[..], &search).unwrap();
        let now = found.revision().number;
        let last = answers.last().map(|last| last.found.revision().number);
        assert!(last <= Some(now), "it went back from {last:?}");
        if last != Some(now) {
            answers.push(ReplicaAnswer {
                state,
                question,
                found,
            });
        }
    }
    answers
}

/// Asserts that a replica has exactly the stored points.
pub(super) fn compare(replica: &Replica, points: &Linear) {
    let view = replica.view().unwrap();
    assert_eq!(view.len(), points.len());
    for expected in points.iter() {
        let point = view.get(expected.id).unwrap();
        assert_eq!(bits(&point.row), bits(expected.row));
        assert_eq!(
            (point.tag, point.revision),
            (expected.tag, expected.revision)
        );
    }
}

/// Replays the history and compares each answer with brute force at its revision. Returns the points at the end.
pub(super) fn check(space: &Space, past: &History, mut answers: Vec<ReplicaAnswer>) -> Linear {
    answers.sort_by_key(|answered| answered.found.revision().number);
    let mut answers = answers.into_iter().peekable();
    let mut points = Linear::new(space.clone());
    let mut compare = |revision: u64, points: &Linear| {
        while let Some(answered) = answers.next_if(|next| next.found.revision().number == revision)
        {
            let question = answered.question;
            let expected = brute_force::search(points, &answered.state, &question.plain());
            let found = pairs(answered.found.into_vec());
            assert_eq!(found, expected, "{question:?} at {revision}");
        }
    };
    compare(0, &points);
    for (expected, (&revision, change)) in (1..).zip(past) {
        assert_eq!(revision, expected, "a revision that nobody made");
        apply(&mut points, revision, change);
        compare(revision, &points);
    }
    assert!(
        answers.next().is_none(),
        "an answer of a revision that nobody made"
    );
    points
}

fn apply(points: &mut Linear, revision: u64, change: &Change) {
    match change {
        Change::Stored { ids, rows, tag } => {
            brute_force::store(points, ids, rows, *tag, revision);
        }
        Change::Tagged { ids, tag } => {
            for &id in ids {
                let point = points.get(id).unwrap();
                let (row, stored) = (point.row.to_vec(), point.revision);
                points
                    .insert(PointRef {
                        id,
                        tag: *tag,
                        revision: stored,
                        row: &row,
                    })
                    .unwrap();
            }
        }
        Change::Removed { ids } => {
            for &id in ids {
                assert!(points.remove(id));
            }
        }
    }
}
